from __future__ import annotations

from miniatures.surfels import SurfelHost

from fragprune_plugins.testing import AdapterConformance


class TestSurfels(AdapterConformance):
    adapter = "2dgs"
    host = SurfelHost
