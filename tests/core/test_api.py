"""One line in a fork, in a process of its own."""

import sys
from types import ModuleType

import pytest
from miniatures.runs import written

from fragprune_plugins.testing import Host
from fragprune_plugins.testing.fresh import fresh


@pytest.fixture
def fork(tmp_path):
    """The demo's host as somebody's fork of it, rewritten for the CPU."""
    root = written(Host, tmp_path / "fork")
    for path in root.rglob("*.py"):
        path.write_text(path.read_text().replace('"cuda"', '"cpu"').replace(".cuda()", ""))
    return root


SCRIPT = """
import sys
sys.argv[0] = sys.argv[1] + "/train.py"
sys.path.insert(0, sys.argv[1])
import fragprune_plugins
session = fragprune_plugins.activate(stage="joint", settings=fragprune_plugins.Settings(20))

from types import SimpleNamespace
import numpy as np, torch
from arguments import OptimizationParams
from argparse import ArgumentParser
import gaussian_renderer
from gaussian_renderer import render
from scene.cameras import Camera
from scene.gaussian_model import GaussianModel
from fragprune_plugins.errors import LateImportError, SessionError

seen = {}
cloud = SimpleNamespace(
    points=np.random.default_rng(0).uniform(-1, 1, (20, 3)), colors=np.full((20, 3), 0.5)
)
model = GaussianModel(1)
model.create_from_pcd(cloud, 1.0)
parser = ArgumentParser()
model.training_setup(OptimizationParams(parser).extract(parser.parse_args([])))
camera = Camera(
    0, np.eye(3), np.array([0, 0, 3.0]), 0.8, 0.6, np.zeros((18, 24, 3), np.uint8), "a", "cpu"
)
pipe = SimpleNamespace(debug=False, compute_cov3D_python=False, convert_SHs_python=False)
def draw():
    return render(camera, model, pipe, torch.zeros(3))["render"]
for iteration in (1, 2):
    model.update_learning_rate(iteration)
    draw().abs().mean().backward()
    model.optimizer.step()
    model.optimizer.zero_grad(set_to_none=True)
store = session.store(model)
seen["steps"] = store.steps
with torch.no_grad():
    store.logits.fill_(20.0)
    seen["truncated"] = not draw().any().item()
    with fragprune_plugins.paused():
        seen["paused"] = draw().any().item()
    seen["truncated again"] = not draw().any().item()
try:
    fragprune_plugins.activate()
except SessionError:
    seen["twice is refused"] = True
seen["undone"] = fragprune_plugins.deactivate() == fragprune_plugins.deactivate() == []
seen["inactive"] = "diff_gaussian_rasterization" not in sys.modules
with fragprune_plugins.paused():
    seen["paused when inactive"] = True
try:  # below the imports
    fragprune_plugins.activate(host=sys.argv[1], adapter="vanilla_3dgs", stage="off")
except LateImportError as error:
    seen["late"] = "__main__" in error.found
seen["untouched"] = gaussian_renderer.render is render
"""
SHELL = """
import os, sys
import fragprune_plugins
os.chdir(sys.argv[1])
sys.ps1, sys.argv[0] = "> ", sys.argv[2]
seen = fragprune_plugins.activate().adapter.name
"""


def main(code, *words):
    """What a program has seen, whose module has no file."""
    sys.argv, sys.modules["__main__"] = ["-c", *words], ModuleType("__main__")
    exec(code, vars(sys.modules["__main__"]))
    return sys.modules["__main__"].seen


@pytest.mark.parametrize("launcher", ["", "/usr/lib/ipykernel_launcher.py"])
def test_a_shell_finds_the_host_in_the_current_folder(fork, launcher):
    assert fresh(main, SHELL, str(fork), launcher) == "vanilla-3dgs"


def test_one_line_above_the_imports_is_enough_and_below_them_it_is_refused(fork):
    seen = fresh(main, SCRIPT, str(fork))
    assert seen.pop("steps") == 2
    assert len(seen) == 9
    assert all(seen.values()), seen
