from __future__ import annotations

from conformance.relatives import RelativeConformance
from miniatures.surfels import SurfelHost


class TestSurfels(RelativeConformance):
    adapter = "2dgs"
    host = SurfelHost
