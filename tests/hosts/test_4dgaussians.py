"""The real 4DGaussians, unmodified, where ``FRAGPRUNE_HOSTS`` points at a folder with it.

The host resizes pictures of this layout to 800x800, so a few dozen iterations take minutes.
"""

import re
import subprocess
import sys
from importlib.util import find_spec
from pathlib import Path

import pytest
from hosts.test_checkouts import each_of

from fragprune_4dgaussians import MovingGaussians

pytestmark = [pytest.mark.slow, pytest.mark.timeout(900)]

every_moving = each_of(MovingGaussians())

FRAMES = Path(__file__).parents[2] / "docs" / "how-to" / "4dgaussians_frames.py"

NEEDS = ("torchvision", "matplotlib", "cv2")

TRAIN = (
    "--iterations 14 --coarse_iterations 6 --densify_from_iter 2 --densification_interval 4 "
    "--densify_until_iter 12 --densify_grad_threshold_coarse 0.0002 --test_iterations -1 --port 0"
)

RUN = """
import contextlib, json, sys
import torch
torch.set_num_threads(1)
from fragprune_plugins.injection.launch import RunOptions, run
from fragprune_plugins.learning.schedule import Settings
from fragprune_plugins.files import sidecar
from fragprune_plugins.files.ply import read_ply
host, data, out, *flags = sys.argv[1:]
names = ("xyz", "f_dc", "f_rest", "scaling", "rotation", "opacity")
with contextlib.redirect_stdout(sys.stderr):
    settings = Settings(iterations=6, threshold_lr=0.3, train="opacity")
    words = [f"{host}/train.py", "-s", data, "-m", out, *flags]
    summary = run(words, RunOptions(device="cpu", settings=settings))
    files = summary.model_before, summary.model_after
    before, after = map(read_ply, files)
    one, other = (
        torch.load(file.with_name("deformation.pth"), weights_only=True) for file in files
    )
    store, _ = sidecar.load(summary.model_after)
    report = {
        "moved": [n for n in names if not torch.equal(getattr(before, n), getattr(after, n))],
        "network stands": all(torch.equal(one[name], other[name]) for name in one),
        "rows": [len(before.xyz), len(after.xyz), len(store)],
        "steps": [summary.iterations, store.steps],
        "models": [str(file.parent) for file in files],
        "fragments": [summary.fragments_before, summary.fragments_after],
    }
print(json.dumps(report))
"""


@every_moving
@pytest.mark.skipif(
    any(find_spec(name) is None for name in NEEDS), reason=f"the host imports {', '.join(NEEDS)}"
)
def test_training_then_fine_tuning(host, recording, tmp_path, python):
    report = python(RUN, host, recording, tmp_path / "out", *TRAIN.split())
    assert report["moved"] == ["opacity"]
    assert report["network stands"]
    assert len(set(report["rows"])) == 1
    assert report["steps"] == [6, 6]
    before, after = report["fragments"]
    assert after < before
    assert [Path(each).name for each in report["models"]] == ["iteration_14", "iteration_21"]
    frames = [sys.executable, str(FRAMES), str(host), *report["models"]]
    drawn = subprocess.run(
        [*frames, "--rounds", "1", "--device", "cpu"], check=True, capture_output=True, text=True
    ).stdout
    first, second = re.findall(r"(\d+) Gaussians, .* per pixel, .* dB, SSIM", drawn)
    assert first == second == str(report["rows"][0])
    assert "2 views of 800x800 pixels" in drawn
    assert len(re.findall(r"ms, least .*x$", drawn, re.MULTILINE)) == 2
