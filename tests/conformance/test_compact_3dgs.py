from __future__ import annotations

from miniatures.compact_3dgs import CompactHost

from fragprune_plugins.testing import AdapterConformance


class TestCompact3DGS(AdapterConformance):
    adapter = "compact-3dgs"
    host = CompactHost
