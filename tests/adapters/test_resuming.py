"""Stage 2 of a host that was killed goes on, and ends as one that was not."""

from __future__ import annotations

import os
import shutil
import signal
import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import pytest
import torch
from miniatures.runs import OPTIONS, command
from miniatures.vanilla_3dgs import HOST

from fragprune_plugins.injection import launch, stepping
from fragprune_plugins.learning.schedule import Settings
from fragprune_plugins.storage import checkpoints, models

SETTINGS = Settings(iterations=12, threshold_lr=0.3, train="appearance")
FINETUNE = replace(
    OPTIONS, settings=SETTINGS, stage="finetune", engine="cpu", again=False, checkpoint_every=1e-9
)
KEPT = "stage2.fragprune-unfinished"
KILLED = """
import os, signal, sys
sys.path[:0] = sys.argv[2:4]
from adapters import test_resuming
test_resuming.kill_at(int(sys.argv[1]))
test_resuming.launch.run(sys.argv[4:], test_resuming.FINETUNE)
"""


def kill_at(step):
    """SIGKILL this process when a step is reported."""
    report = stepping.report

    def killing(session, stats):
        report(session, stats)
        if stats.step == step:
            os.kill(os.getpid(), signal.SIGKILL)

    stepping.report = killing


@pytest.fixture(scope="module")
def trained(photographs, tmp_path_factory):
    """The folder of a finished stage 1, and its scene."""
    out = tmp_path_factory.mktemp("resuming") / "out"
    words = command(HOST / "train.py", photographs, out, 20, "--checkpoint_iterations", 20)
    launch.run(words, replace(OPTIONS, stage="off"))
    return out, photographs


def again(trained, folder, *more):
    """A copy of stage 1 at the same place, and the host's command for it."""
    out, scene = trained
    target = folder / "out"
    shutil.copytree(out, target)
    return target, command(HOST / "train.py", scene, target, 20, *more)


def killed(words, step):
    tests = Path(__file__).parents[1]
    done = subprocess.run(
        [sys.executable, "-c", KILLED, str(step), str(tests), str(tests.parent), *words],
        capture_output=True,
        text=True,
        cwd=tests.parent,
        env=os.environ | {"OMP_NUM_THREADS": "1"},
    )
    assert done.returncode == -signal.SIGKILL, done.stderr


def result(out):
    return models.load(max(out.glob("point_cloud/*/point_cloud.ply")))  # iteration 33, and not 20


def expect_same(one, other):
    for name in ("opacity", "f_dc", "f_rest", "xyz", "scaling", "rotation"):
        assert torch.equal(getattr(one.splat, name), getattr(other.splat, name)), name
    for name, numbers in one.thresholds.numbers.items():
        assert torch.equal(numbers, other.thresholds.numbers[name]), name


def test_a_killed_stage_two_ends_as_one_that_was_not(trained, tmp_path):
    whole, words = again(trained, tmp_path / "whole")
    summary = launch.run(words, FINETUNE)
    assert not (whole / KEPT).exists()

    out, words = again(trained, tmp_path / "killed")
    killed(words, 5)
    assert (out / KEPT).exists()
    killed(words, 9)
    step = checkpoints.load(out / KEPT)[1]["step"]
    assert step in (8, 9)
    resumed = launch.run(words, FINETUNE)
    expect_same(result(whole), result(out))
    assert resumed.curves == summary.curves
    assert resumed.fragments_before == summary.fragments_before
    assert resumed.fragments_after == summary.fragments_after
    assert not (out / KEPT).exists()
    assert launch.run(words, FINETUNE).already_finished
