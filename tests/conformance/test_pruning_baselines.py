from conformance.relatives import RelativeConformance
from miniatures.lp_3dgs import LPHost
from miniatures.speedy_splat import SpeedyHost


class TestSpeedySplat(RelativeConformance):
    adapter = "speedy-splat"
    host = SpeedyHost


class TestLP3DGS(RelativeConformance):
    adapter = "lp-3dgs"
    host = LPHost
