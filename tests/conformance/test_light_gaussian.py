from __future__ import annotations

from miniatures.light_gaussian import LightGaussianHost

from fragprune_plugins.testing import AdapterConformance


class TestLightGaussian(AdapterConformance):
    adapter = "light-gaussian"
    host = LightGaussianHost
