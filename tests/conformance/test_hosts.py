"""Every adapter keeps every promise on its host: a miniature of it, or the installed package."""

import ast
from pathlib import Path

import pytest
from installed.gaussian_splatting_host import GaussianSplattingHost, MCMCHost
from installed.gsplat_host import GsplatHost
from miniatures.hosts import HOSTS
from miniatures.rt_4dgs import PythonHost, RigidHost

from fragprune_plugins.testing import AdapterConformance
from fragprune_plugins.testing.plugin import NOT_APPLICABLE


class TestVanilla3DGS(AdapterConformance):
    adapter = "vanilla-3dgs"


class TestGaussianSplatting(AdapterConformance):
    adapter = "gaussian-splatting"
    host = GaussianSplattingHost


class TestGsplat(AdapterConformance):
    adapter = "gsplat"
    host = GsplatHost


class RelativeConformance(AdapterConformance):
    """All invariants of hosts that share their patches with one above, in fewer orders of import:
    vanilla's test tries more and longer ones."""

    longest_order = 2
    examples = 6


class TestFork(RelativeConformance):
    adapter = "3dgs-fork"
    host = HOSTS["3dgs-fork"]

    def test_refuse(self, case: object) -> None:
        pytest.skip(f"{NOT_APPLICABLE}it reads signatures: what it refuses, core/test_forks says")


def relative(adapter, host=None, **options):
    """The tests of an adapter whose host shares its patches with one above."""
    stated = {"adapter": adapter, "host": host or HOSTS[adapter]} | options
    return type("Relative", (RelativeConformance,), stated)


SAME_SOURCE = {"test_refuse": None}  # it reads nothing else
FEW = {"examples": 5, "test_off_is_off": None} | SAME_SOURCE
TestGaussianSplattingMCMC = relative("gaussian-splatting", MCMCHost, **SAME_SOURCE)
for name in sorted(HOSTS.keys() - {"vanilla-3dgs", "3dgs-fork"}):  # each worker collects alike
    globals()[f"Test{name}"] = relative(name)
TestRT4DGSWithout4DRotation = relative("rt-4dgs", RigidHost, **FEW)
TestRT4DGSSlicedInPython = relative("rt-4dgs", PythonHost, **FEW)

OURS = {path.stem for path in Path(__file__).parents[1].iterdir()}


@pytest.mark.parametrize("host", HOSTS)
def test_a_miniature_imports_nothing_of_ours(host, tmp_path):
    """It is a program of its own, as a checkout is."""
    HOSTS[host]().write(tmp_path)
    nodes = [x for file in tmp_path.rglob("*.py") for x in ast.walk(ast.parse(file.read_text()))]
    names = [a.name for node in nodes if isinstance(node, ast.Import) for a in node.names]
    names += [node.module or "" for node in nodes if isinstance(node, ast.ImportFrom)]
    imported = {name.split(".")[0] for name in names}
    assert {"torch", "scene"} <= imported
    assert not imported & OURS
    assert not [file for file in tmp_path.rglob("*.py") if "fragprune" in file.read_text()]
    assert not (tmp_path / "__init__.py").exists()
