from conformance.relatives import RelativeConformance
from miniatures.light_gaussian import LightGaussianHost


class TestLightGaussian(RelativeConformance):
    adapter = "light-gaussian"
    host = LightGaussianHost
