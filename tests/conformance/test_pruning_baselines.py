from __future__ import annotations

from baseline_hosts import LPHost, SpeedyHost

from fragprune_plugins.testing import AdapterConformance


class TestSpeedySplat(AdapterConformance):
    adapter = "speedy-splat"
    host = SpeedyHost


class TestLP3DGS(AdapterConformance):
    adapter = "lp-3dgs"
    host = LPHost
