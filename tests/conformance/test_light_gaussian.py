from __future__ import annotations

from light_gaussian_host import LightGaussianHost

from fragprune_plugins.testing import AdapterConformance


class TestLightGaussian(AdapterConformance):
    adapter = "light-gaussian"
    host = LightGaussianHost
