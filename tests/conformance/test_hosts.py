"""Every adapter keeps every promise on its host: a miniature of it, or the installed package."""

import ast
from pathlib import Path

import pytest
from conformance.relatives import RelativeConformance
from installed.gaussian_splatting_host import GaussianSplattingHost
from installed.gaussian_splatting_host import MCMCHost as InstalledMCMCHost
from miniatures.changed import ForkHost
from miniatures.compact_3dgs import CompactHost
from miniatures.light_gaussian import LightGaussianHost
from miniatures.lp_3dgs import LPHost
from miniatures.mcmc import MCMCHost
from miniatures.mini_splatting import MiniSplattingHost
from miniatures.mip_splatting import MipHost
from miniatures.moving import MovingHost
from miniatures.rain_gs import RainHost
from miniatures.rt_4dgs import PythonHost, RigidHost, RT4DGSHost
from miniatures.speedy_splat import SpeedyHost
from miniatures.surfels import SurfelHost

from fragprune_plugins.testing import AdapterConformance, Host


class TestVanilla3DGS(AdapterConformance):
    adapter = "vanilla-3dgs"


class TestGaussianSplatting(AdapterConformance):
    adapter = "gaussian-splatting"
    host = GaussianSplattingHost


def relative(adapter: str, host: type[Host], **options: object) -> type[RelativeConformance]:
    """The tests of an adapter whose host shares its patches with one above."""
    return type("Relative", (RelativeConformance,), {"adapter": adapter, "host": host, **options})


FEW = {"examples": 5, "longest_order": 1}
TestGaussianSplattingMCMC = relative("gaussian-splatting", InstalledMCMCHost)
TestSurfels = relative("2dgs", SurfelHost)
Test4DGaussians = relative("4dgaussians", MovingHost)
TestCompact3DGS = relative("compact-3dgs", CompactHost)
TestLightGaussian = relative("light-gaussian", LightGaussianHost)
TestLP3DGS = relative("lp-3dgs", LPHost)
TestMCMC = relative("mcmc", MCMCHost)
TestMiniSplatting = relative("mini-splatting", MiniSplattingHost)
TestMipSplatting = relative("mip-splatting", MipHost)
TestRainGS = relative("rain-gs", RainHost)
TestRT4DGS = relative("rt-4dgs", RT4DGSHost)
TestRT4DGSWithout4DRotation = relative("rt-4dgs", RigidHost, **FEW)
TestRT4DGSSlicedInPython = relative("rt-4dgs", PythonHost, **FEW)
TestSpeedySplat = relative("speedy-splat", SpeedyHost)

MINIATURES = (
    *(Host, CompactHost, ForkHost, LightGaussianHost, LPHost, MCMCHost, MiniSplattingHost),
    *(MipHost, MovingHost, RainHost, RT4DGSHost, SpeedyHost, SurfelHost),
)
OURS = {path.stem for path in Path(__file__).parents[1].iterdir()}


@pytest.mark.parametrize("host", MINIATURES)
def test_a_miniature_imports_nothing_of_ours(host, tmp_path):
    """It is a program of its own, as a checkout is."""
    host().write(tmp_path)
    nodes = [
        each for file in tmp_path.rglob("*.py") for each in ast.walk(ast.parse(file.read_text()))
    ]
    names = [a.name for node in nodes if isinstance(node, ast.Import) for a in node.names]
    names += [node.module or "" for node in nodes if isinstance(node, ast.ImportFrom)]
    imported = {name.split(".")[0] for name in names}
    assert {"torch", "scene"} <= imported
    assert not imported & OURS
    assert not [name for name in imported if name.startswith("fragprune")]
