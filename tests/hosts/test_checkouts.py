"""Real checkouts, unmodified, where ``FRAGPRUNE_HOSTS`` points at a folder of them.

None is kept here: their licence is not ours. The conformance kit tries each adapter on its
checkouts; these tests run the hosts' own training scripts. ``FRAGPRUNE_TEST_DATA`` may name a
folder that holds ``fox/colmap160``, or is itself a COLMAP dataset; otherwise the demo's room is
photographed.
"""

import json
import os
import re
import subprocess
import sys
from dataclasses import dataclass
from importlib.util import find_spec
from pathlib import Path

import pytest
from hosts.training import STEPS, learned

from fragprune_plugins.hosts.source import HostRepo
from fragprune_plugins.testing.conformance import found_adapter
from fragprune_plugins.testing.fresh import fresh
from fragprune_vanilla_3dgs import Vanilla3DGS

pytestmark = [pytest.mark.slow, pytest.mark.timeout(900)]

FOLDER = os.environ.get("FRAGPRUNE_HOSTS")
HOW_TO = Path(__file__).parents[2] / "docs" / "how-to"


def checkouts(name: str) -> list[Path]:
    """Folders that an adapter is for."""
    found = sorted(path for path in Path(FOLDER).iterdir() if path.is_dir()) if FOLDER else []
    return [path for path in found if found_adapter(name).match(HostRepo(path)).fits]


def each_of(name: str, *more: object) -> list:
    """Parameters for every checkout of an adapter; one that is skipped if there is none."""
    reason = f"FRAGPRUNE_HOSTS names no folder with a checkout of {name} in it"
    none = pytest.param(None, *more, marks=pytest.mark.skip(reason=reason), id=f"no {name}")
    return [pytest.param(path, *more, id=path.name) for path in checkouts(name)] or [none]


@dataclass(frozen=True)
class Training:
    """How a host is trained in these tests.

    Attributes:
        flags: what the host needs beside ``FLAGS``.
        script: that trains.
        needs: packages that the host imports.
        checkpoint: of the iteration after which the host's training ends in an error of its own.
    """

    flags: str = "--port 0"
    script: str = "train.py"
    needs: tuple[str, ...] = ()
    checkpoint: int = 0


FLAGS = """-s {data} -m {out} --eval -r 1 --sh_degree 1 --test_iterations -1
--iterations 30 --densify_from_iter 5 --densification_interval 10 --densify_until_iter 25
--densify_grad_threshold 0.002"""
MOVING = """-s {data} -m {out} --iterations 14 --coarse_iterations 6 --densify_from_iter 2
--densification_interval 4 --densify_until_iter 12 --densify_grad_threshold_coarse 0.0002
--test_iterations -1 --port 0"""
DRAWS = ("torchvision",)
TRAININGS = {
    "vanilla-3dgs": [Training()],
    "2dgs": [Training()],
    "mcmc": [Training("--cap_max 3100 --init_type sfm")],
    "mip-splatting": [Training()],
    "rain-gs": [Training("--port 0 --exp_name a")],
    "light-gaussian": [
        Training("--port 0 --prune_iterations 20 33", script="train_densify_prune.py")
    ],
    "mini-splatting": [
        Training(script="gs/train.py"),
        Training("--port 0 --imp_metric outdoor", script="ms/train.py"),
        Training(script="ms_d/train.py"),
    ],
    "speedy-splat": [Training(needs=DRAWS)],
    "lp-3dgs": [
        Training(f"--port 0 --prune_method {method}", needs=DRAWS, checkpoint=30)
        for method in ("3dgs", "mini_splatting", "rad_splat")
    ],
}


def expect_opacities_moved_alone(found):
    assert found.moved == ["opacity"]
    assert len(set(found.rows)) == 1
    assert found.steps == (STEPS, STEPS)
    before, after = found.fragments
    assert after < before


def need(*packages):
    if missing := [name for name in packages if find_spec(name) is None]:
        pytest.skip(f"the host imports {', '.join(missing)}")


@pytest.mark.parametrize(
    ("host", "training"),
    [case for name, trainings in TRAININGS.items() for t in trainings for case in each_of(name, t)],
)
def test_training_then_fine_tuning(host, training, dataset, tmp_path):
    need(*training.needs)
    words = f"{host / training.script} {FLAGS} {training.flags}"
    words = words.format(data=dataset, out=tmp_path / "out").split()
    expect_opacities_moved_alone(fresh(learned, words, "auto", training.checkpoint, seconds=800))


@pytest.mark.parametrize("host", each_of("vanilla-3dgs"))
def test_exposures_of_a_late_host_come_through_stage_two_unchanged(host, dataset, tmp_path):
    if "2023" in Vanilla3DGS().revision(HostRepo(host)):
        pytest.skip("this state has no exposures")
    words = f"{host / 'train.py'} {FLAGS} --port 0 --train_test_exp"
    words = words.format(data=dataset, out=tmp_path).split()
    found = []
    for stage in ("auto", "finetune"):
        fresh(learned, words, stage, seconds=800)
        found.append(json.loads((tmp_path / "exposure.json").read_text()))
    identity = [[float(i == j) for j in range(4)] for i in range(3)]
    assert any(value != identity for value in found[0].values())
    assert found[0] == found[1]


def frames(script, host, *words):
    """What a script of docs/how-to says of two models."""
    line = [sys.executable, HOW_TO / script, host, *words, "--rounds", 1, "--device", "cpu"]
    done = subprocess.run(list(map(str, line)), check=True, capture_output=True, text=True)
    assert len(re.findall(r"ms, least .*x$", done.stdout, re.MULTILINE)) == 2
    return done.stdout


@pytest.mark.parametrize("host", each_of("4dgaussians"))
def test_a_network_that_moves_gaussians_stands_still(host, recording, tmp_path):
    """The host resizes pictures of this layout to 800x800: this takes minutes."""
    need("torchvision", "matplotlib", "cv2")
    words = f"{host / 'train.py'} {MOVING}".format(data=recording, out=tmp_path / "out").split()
    found = fresh(learned, words, "auto", seconds=800)
    expect_opacities_moved_alone(found)
    folders = [model.parent for model in found.models]
    assert [folder.name for folder in folders] == ["iteration_14", "iteration_21"]
    drawn = frames("4dgaussians_frames.py", host, *folders)
    counts = re.findall(r"(\d+) Gaussians, .* per pixel, .* dB, SSIM", drawn)
    assert counts == [str(found.rows[0])] * 2
    assert "2 views of 800x800 pixels" in drawn


YAML = """
gaussian_dim: 4
time_duration: [0.0, 1.0]
num_pts: 300
batch_size: 2
rot_4d: {rot}
test_iterations: [-1]
ModelParams:
  source_path: "{data}"
  model_path: "{out}"
  sh_degree: 3
  eval: True
PipelineParams:
  eval_shfs_4d: True
  compute_cov3D_python: {python}
  env_map_res: 0
OptimizationParams:
  iterations: 30
  densify_from_iter: 5
  densification_interval: 10
  densify_until_iter: 25
  densify_grad_threshold: 0.002
  sh_increase_interval: 5
  lambda_opa_mask: 0.05
  lambda_rigid: {rigid}
  lambda_motion: {rigid}
"""


@pytest.mark.parametrize("host", each_of("rt-4dgs"))
@pytest.mark.parametrize(
    ("rot", "python_slices"),
    [(True, False), (False, False), (True, True)],
    ids=["4D rotation", "without", "sliced in Python"],
)
def test_gaussians_of_space_and_time_stand_still(host, recording, tmp_path, rot, python_slices):
    need("omegaconf", "imagesize", "kornia", "torchmetrics", "torchvision")
    config = tmp_path / "a.yaml"
    values = {"rot": rot, "python": python_slices, "data": recording, "out": tmp_path / "out"}
    rigid = 0.5 if rot else 0.0  # the host's losses on velocities need 4D rotation
    config.write_text(YAML.format(**values, rigid=rigid))
    found = fresh(learned, [str(host / "train.py"), "--config", str(config)], "auto", seconds=800)
    expect_opacities_moved_alone(found)
    drawn = frames("rt_4dgs_frames.py", host, config, *found.models, "--enlarge", 2)
    assert re.findall(r"(\d+) Gaussians, .* dB, SSIM", drawn) == [str(found.rows[0])] * 2
    assert "frames of 96x96 pixels" in drawn
