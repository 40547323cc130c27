from __future__ import annotations

from miniatures.rain_gs import RainHost

from fragprune_plugins.testing import AdapterConformance


class TestRainGS(AdapterConformance):
    adapter = "rain-gs"
    host = RainHost
