from __future__ import annotations

from mini_splatting_host import MiniSplattingHost

from fragprune_plugins.testing import AdapterConformance


class TestMiniSplatting(AdapterConformance):
    adapter = "mini-splatting"
    host = MiniSplattingHost
