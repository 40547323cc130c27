from __future__ import annotations

from miniatures.mip_splatting import MipHost

from fragprune_plugins.testing import AdapterConformance


class TestMipSplatting(AdapterConformance):
    adapter = "mip-splatting"
    host = MipHost
