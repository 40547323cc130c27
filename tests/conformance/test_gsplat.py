from installed.gsplat_host import GsplatHost

from fragprune_plugins.testing import AdapterConformance


class TestGsplat(AdapterConformance):
    adapter = "gsplat"
    host = GsplatHost
