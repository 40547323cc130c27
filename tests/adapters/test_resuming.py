"""Stage 2 of a host that was killed goes on, and ends as one that was not."""

from __future__ import annotations

import json
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
from miniatures.mcmc import MCMCHost
from miniatures.mini_splatting import MiniSplattingHost
from miniatures.runs import OPTIONS, command, written
from miniatures.vanilla_3dgs import HOST

from adapters import test_mini_splatting as mini_splatting
from fragprune_plugins.errors import CheckpointError
from fragprune_plugins.files import checkpoints
from fragprune_plugins.injection import launch, stepping
from fragprune_plugins.learning.schedule import Settings
from fragprune_plugins.workbench.models import model as models

SETTINGS = Settings(iterations=12, threshold_lr=0.3, train="appearance")
FINETUNE = replace(
    OPTIONS, settings=SETTINGS, stage="finetune", engine="cpu", again=False, checkpoint_every=1e-9
)
KEPT = "stage2.fragprune-unfinished"
KILLED = """
import sys
sys.path[:0] = sys.argv[3:5]
from adapters import test_resuming
test_resuming.kill_at(*map(int, sys.argv[1:3]))
test_resuming.launch.run(sys.argv[5:], test_resuming.FINETUNE)
"""


def kill_at(step, number):
    """Send this process a signal when a step is reported."""
    report = stepping.report

    def killing(session, stats):
        report(session, stats)
        if stats.step == step:
            os.kill(os.getpid(), number)

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


def ended(words, step, number):
    """The output of a stage 2 that got a signal at a step."""
    tests = Path(__file__).parents[1]
    words = [str(step), str(int(number)), str(tests), str(tests.parent), *words]
    return subprocess.run(
        [sys.executable, "-c", KILLED, *words],
        capture_output=True,
        text=True,
        cwd=tests.parent,
        env=os.environ | {"OMP_NUM_THREADS": "1"},
    )


def killed(words, step):
    done = ended(words, step, signal.SIGKILL)
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


def test_after_sigterm_the_model_is_there_and_the_same_command_goes_on(trained, tmp_path):
    whole, words = again(trained, tmp_path / "whole")
    launch.run(words, FINETUNE)
    out, words = again(trained, tmp_path / "ended")
    done = ended(words, 5, signal.SIGTERM)
    assert "[terminated]" in done.stderr
    assert "goes on from its last checkpoint" in done.stderr
    learned = out / "point_cloud/iteration_25/point_cloud.ply"
    assert not models.load(learned).thresholds.neutral
    assert checkpoints.load(out / KEPT)[1]["step"] in (4, 5)
    launch.run(words, FINETUNE)
    expect_same(result(whole), result(out))
    assert not (out / KEPT).exists()
    assert learned.exists()  # a result of its own


def of_mcmc(folder, scene, out, *more):
    script = written(MCMCHost, folder) / "train.py"
    return command(script, scene, out, 20, "--noise_lr", 5e7, "--cap_max", 170, *more)


def of_mini_splatting(folder, scene, out, *more):
    return mini_splatting.command(written(MiniSplattingHost, folder), "gs", scene, out, 20, *more)


@pytest.mark.parametrize(
    "words_of", [of_mcmc, pytest.param(of_mini_splatting, marks=pytest.mark.slow)]
)
def test_other_hosts_go_on_to_the_same_bits(words_of, photographs, tmp_path):
    out, kept = tmp_path / "out", tmp_path / "kept"
    words = words_of(tmp_path / "host", photographs, out)
    launch.run([*words, "--checkpoint_iterations", "20"], replace(OPTIONS, stage="off"))
    shutil.copytree(out, kept)
    launch.run(words, FINETUNE)
    whole = result(out)
    shutil.rmtree(out)
    shutil.copytree(kept, out)
    killed(words, 5)
    done = ended(words, 9, signal.SIGTERM)
    assert "[terminated]" in done.stderr
    assert checkpoints.load(out / KEPT)[1]["step"] in (8, 9)
    launch.run(words, FINETUNE)
    expect_same(whole, result(out))


@pytest.fixture(scope="module")
def unfinished(trained, tmp_path_factory):
    """The folder of a stage 2 that was killed, its command, and the checkpoint's content."""
    out, words = again(trained, tmp_path_factory.mktemp("unfinished"))
    killed(words, 3)
    return out, words, (out / KEPT).read_bytes()


@pytest.mark.parametrize("how", ["another shape", "no part", "step 1000", "step null", "a word"])
def test_a_forged_checkpoint_is_stated(unfinished, how):
    out, words, content = unfinished
    (out / KEPT).write_bytes(content)
    tensors, values = checkpoints.load(out / KEPT)
    if how == "another shape":
        name = next(name for name in tensors if name.startswith("host."))
        tensors[name] = tensors[name][:5]
    elif how == "no part":
        del tensors["curves"]
    elif how == "a word":
        values["stage"]["steps"] = "two"
    else:
        values["step"] = json.loads(how.removeprefix("step "))
    checkpoints.save(out / KEPT, tensors, values)
    with pytest.raises(CheckpointError, match="unfinished"):
        launch.run(words, FINETUNE)
