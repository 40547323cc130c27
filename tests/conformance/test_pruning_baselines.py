from __future__ import annotations

from miniatures.lp_3dgs import LPHost
from miniatures.speedy_splat import SpeedyHost

from fragprune_plugins.testing import AdapterConformance


class TestSpeedySplat(AdapterConformance):
    adapter = "speedy-splat"
    host = SpeedyHost


class TestLP3DGS(AdapterConformance):
    adapter = "lp-3dgs"
    host = LPHost
