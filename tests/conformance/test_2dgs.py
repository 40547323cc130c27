from conformance.relatives import RelativeConformance
from miniatures.surfels import SurfelHost


class TestSurfels(RelativeConformance):
    adapter = "2dgs"
    host = SurfelHost
