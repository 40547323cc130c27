from __future__ import annotations

from rain_gs_host import RainHost

from fragprune_plugins.testing import AdapterConformance


class TestRainGS(AdapterConformance):
    adapter = "rain-gs"
    host = RainHost
