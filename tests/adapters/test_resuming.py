"""Stage 2 of a host that was killed goes on, and ends as one that was not."""

from __future__ import annotations

import logging
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


def test_with_other_settings_or_again_it_begins_anew(trained, tmp_path, caplog):
    out, words = again(trained, tmp_path)
    killed(words, 4)
    kept = (out / KEPT).read_bytes()
    other = replace(FINETUNE, settings=replace(SETTINGS, pressure=1e-3), checkpoint_every=1000.0)
    with caplog.at_level(logging.INFO, "fragprune"):
        assert launch.run(words, other).iterations == 12
    assert "the unfinished stage 2 had other pressure, schedule; it begins anew" in caplog.messages
    assert not (out / KEPT).exists()
    (out / KEPT).write_bytes(kept)
    caplog.clear()
    with caplog.at_level(logging.INFO, "fragprune"):
        launch.run(words, replace(FINETUNE, again=True))
    assert not [each for each in caplog.messages if "unfinished" in each]
    assert not (out / KEPT).exists()


def test_what_the_host_saved_before_the_kill_stays(trained, tmp_path):
    more = ("--checkpoint_iterations", 23, 30, "--save_iterations", 24)
    out, words = again(trained, tmp_path, *more)
    killed(words, 8)
    files = [out / "chkpnt23.pth", out / "point_cloud/iteration_24/point_cloud.ply"]
    before = [(file.stat().st_mtime_ns, file.read_bytes()) for file in files]
    launch.run(words, FINETUNE)
    assert [(file.stat().st_mtime_ns, file.read_bytes()) for file in files] == before
    assert (out / "chkpnt30.pth").exists()


def test_without_a_wish_for_it_nothing_is_kept(trained, tmp_path, monkeypatch):
    out, words = again(trained, tmp_path)
    seen = []
    report = stepping.report
    monkeypatch.setattr(
        stepping, "report", lambda *words: seen.append((out / KEPT).exists()) or report(*words)
    )
    launch.run(words, replace(FINETUNE, checkpoint_every=0))
    assert seen == [False] * 12
    assert not (out / KEPT).exists()
