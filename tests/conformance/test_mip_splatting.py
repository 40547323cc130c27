from __future__ import annotations

from mip_splatting_host import MipHost

from fragprune_plugins.testing import AdapterConformance


class TestMipSplatting(AdapterConformance):
    adapter = "mip-splatting"
    host = MipHost
