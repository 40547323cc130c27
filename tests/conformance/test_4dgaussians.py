from __future__ import annotations

from miniatures.moving import MovingHost

from fragprune_plugins.testing import AdapterConformance


class Test4DGaussians(AdapterConformance):
    adapter = "4dgaussians"
    host = MovingHost
