"""A miniature is a program of its own, as a checkout is."""

import ast
from pathlib import Path

import pytest
from miniatures.light_gaussian import LightGaussianHost
from miniatures.lp_3dgs import LPHost
from miniatures.mcmc import MCMCHost
from miniatures.mini_splatting import MiniSplattingHost
from miniatures.mip_splatting import MipHost
from miniatures.moving import MovingHost
from miniatures.rain_gs import RainHost
from miniatures.rt_4dgs import RT4DGSHost
from miniatures.speedy_splat import SpeedyHost
from miniatures.surfels import SurfelHost

from fragprune_plugins.testing import Host

HOSTS = (
    *(Host, MCMCHost, LightGaussianHost, MiniSplattingHost, MipHost, RainHost, RT4DGSHost),
    *(SpeedyHost, LPHost, SurfelHost, MovingHost),
)
OURS = {path.stem for path in Path(__file__).parents[1].iterdir()}


@pytest.mark.parametrize("host", HOSTS)
def test_a_miniature_imports_nothing_of_ours(host, tmp_path):
    host().write(tmp_path)
    files = list(tmp_path.rglob("*.py"))
    imported = {name.split(".")[0] for file in files for name in names_imported(file)}
    assert {"torch", "scene"} <= imported
    assert not imported & OURS
    assert not [name for name in imported if name.startswith("fragprune")]


def names_imported(file: Path) -> list[str]:
    nodes = list(ast.walk(ast.parse(file.read_text())))
    plain = [alias.name for node in nodes if isinstance(node, ast.Import) for alias in node.names]
    return plain + [node.module or "" for node in nodes if isinstance(node, ast.ImportFrom)]
