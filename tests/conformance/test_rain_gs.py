from conformance.relatives import RelativeConformance
from miniatures.rain_gs import RainHost


class TestRainGS(RelativeConformance):
    adapter = "rain-gs"
    host = RainHost
