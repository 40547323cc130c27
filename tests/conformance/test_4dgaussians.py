from conformance.relatives import RelativeConformance
from miniatures.moving import MovingHost


class Test4DGaussians(RelativeConformance):
    adapter = "4dgaussians"
    host = MovingHost
