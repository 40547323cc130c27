from __future__ import annotations

from miniatures.mini_splatting import MiniSplattingHost

from fragprune_plugins.testing import AdapterConformance


class TestMiniSplatting(AdapterConformance):
    adapter = "mini-splatting"
    host = MiniSplattingHost
