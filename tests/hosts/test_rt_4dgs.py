"""The real RT-4DGS, unmodified, where ``FRAGPRUNE_HOSTS`` points at a folder with it."""

import re
import subprocess
import sys
from importlib.util import find_spec
from pathlib import Path

import pytest
from hosts.test_checkouts import each_of

from fragprune_rt_4dgs import RT4DGS

pytestmark = [pytest.mark.slow, pytest.mark.timeout(900)]

every_rt = each_of(RT4DGS())

FRAMES = Path(__file__).parents[2] / "docs" / "how-to" / "rt_4dgs_frames.py"

NEEDS = ("omegaconf", "imagesize", "kornia", "torchmetrics", "torchvision")


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

RUN = """
import contextlib, json, sys
import torch
torch.set_num_threads(1)
from fragprune_plugins.injection.launch import RunOptions, run
from fragprune_plugins.learning.schedule import Settings
host, config = sys.argv[1:]
names = ("degree", "xyz", "dc", "rest", "scaling", "rotation", "opacity")
with contextlib.redirect_stdout(sys.stderr):
    settings = Settings(iterations=10, threshold_lr=0.3, train="opacity")
    options = RunOptions(device="cpu", settings=settings)
    summary = run([f"{host}/train.py", "--config", config], options)
    before, after = (
        torch.load(path, weights_only=False)[0]
        for path in (summary.model_before, summary.model_after)
    )
    same = lambda a, b: torch.equal(a, b) if torch.is_tensor(a) else a == b
    kept = [i for i in (*range(7), 13, 14, 15, 18) if same(before[i], after[i])]
    learned = after[11]["fragprune"]
    report = {
        "moved": [names[i] if i < 7 else i for i in (*range(7), 13, 14, 15, 18) if i not in kept],
        "rows": [len(before[1]), len(after[1]), len(learned["logits"])],
        "steps": [summary.iterations, learned["steps"]],
        "models": [str(summary.model_before), str(summary.model_after)],
        "fragments": [summary.fragments_before, summary.fragments_after],
    }
print(json.dumps(report))
"""


@every_rt
@pytest.mark.skipif(
    any(find_spec(name) is None for name in NEEDS), reason=f"the host imports {', '.join(NEEDS)}"
)
@pytest.mark.parametrize(
    ("rot", "python_slices"),
    [(True, False), (False, False), (True, True)],
    ids=["4D rotation", "without", "sliced in Python"],
)
def test_training_then_fine_tuning(host, recording, tmp_path, python, rot, python_slices):
    config = tmp_path / "a.yaml"
    values = {"rot": rot, "python": python_slices, "data": recording, "out": tmp_path / "out"}
    rigid = 0.5 if rot else 0.0  # the host's losses on velocities need 4D rotation
    config.write_text(YAML.format(**values, rigid=rigid))
    report = python(RUN, host, config)
    assert report["moved"] == ["opacity"]
    assert len(set(report["rows"])) == 1
    assert report["steps"] == [10, 10]
    before, after = report["fragments"]
    assert after < before
    frames = [sys.executable, str(FRAMES), str(host), str(config), *report["models"]]
    drawn = subprocess.run(
        [*frames, "--rounds", "1", "--enlarge", "2", "--device", "cpu"],
        check=True,
        capture_output=True,
        text=True,
    ).stdout
    first, second = re.findall(r"(\d+) Gaussians, .* dB, SSIM", drawn)
    assert first == second == str(report["rows"][0])
    assert "frames of 96x96 pixels" in drawn
    assert len(re.findall(r"ms, least .*x$", drawn, re.MULTILINE)) == 2
