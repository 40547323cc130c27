"""Whole runs of the demo's host through the launcher: neutral, interrupted, resumed, rendered."""

import gc
import json
import shutil
import signal
import sys
import weakref
from dataclasses import replace
from functools import partial
from pathlib import Path

import pytest
import torch
from cli.commands import run as command_line
from finetune.several import ended
from miniatures import runs
from miniatures.hosts import HOSTS
from miniatures.runs import FINETUNE, OFF, OPTIONS
from miniatures.vanilla_3dgs import HOST, InterruptAt, running

from fragprune_plugins import Control, Fewer, Portable, Pressure, Settings
from fragprune_plugins.adapting import Interrupted, SessionError, UsageError, read_ply
from fragprune_plugins.files import sidecar
from fragprune_plugins.injection.launch import RunOptions, run
from fragprune_plugins.plugins.loading import installed
from fragprune_vanilla_3dgs import Vanilla3DGS

command = partial(runs.command, HOST / "train.py")


@pytest.fixture(scope="module")
def stage_one(photographs, tmp_path_factory):
    """A finished stage 1 of ten iterations."""
    out = tmp_path_factory.mktemp("stage_one") / "out"
    run(command(photographs, out, 10), OFF)
    return out


@pytest.fixture
def trained(stage_one, tmp_path):
    """A copy of it."""
    return Path(shutil.copytree(stage_one, tmp_path / "out"))


@pytest.mark.usefixtures("ctrl_c")
def test_ctrl_c_in_stage_two_keeps_what_was_learned_to_be_resumed(photographs, trained, plug):
    plugin = InterruptAt(4)
    plug(plugin)
    with pytest.raises(Interrupted) as caught:
        run(command(photographs, trained, 10), FINETUNE)
    (saved,) = trained.glob("point_cloud/*/*.safetensors")
    model = saved.with_name("point_cloud.ply")
    assert str(model) in caught.value.found
    store, info = sidecar.load(model)
    assert info.adapter == "vanilla-3dgs"
    assert store.steps == 4
    assert not store.neutral
    assert "diff_gaussian_rasterization" not in sys.modules
    assert [summary.steps for summary in plugin.finished] == [4]  # however it ended

    installed.cache_clear()
    learned = store.values.detach()
    assert f"--start_checkpoint {model}" in caught.value.remedy
    named = command(photographs, trained, 10, "--start_checkpoint", model)
    resumed, _ = sidecar.load(run(named, FINETUNE).model_after)
    assert resumed.steps == 4 + 8
    assert (resumed.values.detach() - learned).abs().max() < 0.5
    anew = run(command(photographs, trained, 10), FINETUNE)
    assert sidecar.load(anew.model_after)[0].steps == 8


def test_sigterm_in_stage_two_saves_what_was_learned_and_exits_with_143(photographs, trained, plug):
    before = signal.getsignal(signal.SIGTERM)
    plug(InterruptAt(4, signal.SIGTERM))
    options = ["run", "--device", "cpu", "--stage", "finetune", "--iters", 8, "--json", "--"]
    result = command_line(*options, *command(photographs, trained, 10))
    assert result.exit_code == 143
    error = json.loads(result.stdout)["error"]
    (saved,) = trained.glob("point_cloud/*/*.safetensors")
    assert error["code"] == "terminated"
    assert f"SIGTERM; the thresholds learned so far are beside {saved.parent}" in error["found"]
    assert sidecar.load(saved.with_name("point_cloud.ply"))[0].steps == 4
    assert signal.getsignal(signal.SIGTERM) is before


def test_killed_while_saving_it_starts_from_stage_one(photographs, trained, tmp_path, monkeypatch):
    """The host has written its model, the sidecar is not there yet."""
    killed = Path(shutil.copytree(trained, tmp_path / "killed"))

    def die():
        monkeypatch.setattr(sidecar.atomic, "put", lambda *_: signal.raise_signal(signal.SIGKILL))
        run(command(photographs, killed, 10), FINETUNE)

    assert ended(die) == -signal.SIGKILL
    models = [run(command(photographs, out, 10), FINETUNE).model_after for out in (trained, killed)]
    assert models[0].read_bytes() == models[1].read_bytes()
    one, other = (sidecar.load(model)[0] for model in models)
    assert all(map(torch.equal, one.numbers.values(), other.numbers.values()))
    files = [{p.relative_to(out) for p in out.rglob("*")} for out in (trained, killed)]
    assert files[0] == files[1]


def test_sigterm_in_stage_one_ends_the_process_as_the_host_alone(photographs, tmp_path):
    script = tmp_path / "host" / "train.py"
    shutil.copytree(HOST, script.parent)
    loop = "    for iteration in range(first_iter + 1, opt.iterations + 1):\n"
    kill = "        import signal\n        signal.raise_signal(signal.SIGTERM)\n"
    runs.edit(script, loop, loop + kill)
    words = ["run", "--device", "cpu", "--", str(script)]
    words += command(photographs, tmp_path / "out", 10)[1:]
    assert ended(lambda: command_line(*words)) == -signal.SIGTERM


PORTABLE = replace(FINETUNE, settings=Settings(iterations=8, goal=Portable()))


def test_a_portable_run_moves_shapes_and_leaves_thresholds_neutral(photographs, trained):
    summary = run(command(photographs, trained, 10), PORTABLE)
    before, after = read_ply(summary.model_before), read_ply(summary.model_after)
    assert not torch.equal(before.scaling, after.scaling)
    assert all(c["pressure"] > 0 for c in summary.curves[1:])
    store, info = sidecar.load(summary.model_after)
    assert store.neutral
    assert info.settings["goal"] == "portable"


@pytest.mark.parametrize("goal", [Pressure(), Control()], ids=["pruned", "control"])
def test_a_model_is_saved_though_the_host_saves_none_at_the_end(photographs, tmp_path, goal):
    script = runs.written(HOSTS["vanilla-3dgs"], tmp_path / "host") / "train.py"
    asked = "if iteration in saving_iterations"
    runs.edit(script, asked, f"{asked} and iteration <= 10")
    words = runs.command(script, photographs, tmp_path / "out", 10)
    summary = run(words, replace(OPTIONS, settings=replace(OPTIONS.settings, goal=goal)))
    assert summary.model_after is not None
    store, _ = sidecar.load(summary.model_after)
    assert len(store) == summary.gaussians == len(read_ply(summary.model_after).xyz)
    assert store.neutral == (not goal.learns)


@pytest.mark.usefixtures("ctrl_c")
def test_ctrl_c_keeps_a_portable_model_though_it_has_no_thresholds(photographs, trained, plug):
    plug(InterruptAt(4))
    with pytest.raises(Interrupted, match="the model learned so far is "):
        run(command(photographs, trained, 10), PORTABLE)
    (saved,) = trained.glob("point_cloud/*/*.safetensors")
    assert sidecar.load(saved.with_name("point_cloud.ply"))[0].neutral


@pytest.mark.parametrize("end", ["return", "sys.exit(0)"])
def test_a_host_that_learns_and_draws_nothing_is_always_an_error(photographs, tmp_path, end):
    script = Path(shutil.copytree(HOST, tmp_path / "host")) / "train.py"
    tick = "gaussians.update_learning_rate(iteration)"
    runs.edit(script, tick, f"{tick}; {end}")
    words = runs.command(script, photographs, tmp_path / "out", 10)
    with pytest.raises(SessionError, match="no view of the trained model"):
        run(words, RunOptions(stage="finetune", from_iter=0, device="cpu"))


@pytest.mark.parametrize("from_iter", [None, 18])
def test_only_a_resumed_run_restores_the_folders(photographs, tmp_path, monkeypatch, from_iter):
    """What an earlier training left there must not overwrite what this one has trained."""
    told = []
    monkeypatch.setattr(Vanilla3DGS, "prepare_stage2", lambda self, model, at: told.append(at))
    options = RunOptions(None, "auto", Settings(3), from_iter, device="cpu")
    if from_iter is not None:
        options = replace(options, stage="finetune")
    run(command(photographs, tmp_path / "out", 22), options)
    assert told == [None if from_iter is not None else tmp_path / "out" / "chkpnt22.pth"]


@pytest.fixture(scope="module")
def checkpoint(photographs, tmp_path_factory):
    """Of iteration 12."""
    out = tmp_path_factory.mktemp("trained")
    words = command(photographs, out, 12, "--checkpoint_iterations", 12)
    run(words, RunOptions(stage="off", device="cpu"))
    return out / "chkpnt12.pth"


@pytest.mark.parametrize(
    ("stage", "from_iter", "learned"),
    [("joint", None, 1), ("joint", 3, 7), ("joint", 15, 4), ("finetune", 15, 4)],
)
def test_resumed_it_learns_from_one(photographs, tmp_path, checkpoint, stage, from_iter, learned):
    """Of 13 to 20, in the last of which the host takes no step; densification ends at 18."""
    words = command(photographs, tmp_path / "out", 20, "--start_checkpoint", checkpoint)
    options = RunOptions(stage=stage, from_iter=from_iter, device="cpu")
    store, _ = sidecar.load(run(words, options).model_after)
    assert store.steps == learned


@pytest.mark.parametrize("from_iter", [12, 15])
def test_a_model_saved_where_learning_begins_is_that_of_before(
    photographs, tmp_path, checkpoint, from_iter
):
    more = ["--start_checkpoint", checkpoint, "--save_iterations", 15]
    options = RunOptions(stage="finetune", from_iter=from_iter, device="cpu")
    summary = run(command(photographs, tmp_path / "out", 20, *more), options)
    folder = checkpoint.parent if from_iter == 12 else tmp_path / "out"
    expected = folder / f"point_cloud/iteration_{from_iter}/point_cloud.ply"
    assert (summary.model_before, summary.not_compared) == (expected, None)


@pytest.mark.parametrize("stage", ["joint", "finetune"])
@pytest.mark.parametrize(
    ("iterations", "from_iter", "resumed", "words"),
    [
        (20, 20, False, "iterations 1 to 20; expected iterations after 20.*or lower --from-iter"),
        (20, 25, True, "iterations 13 to 20; expected iterations after 25.*or lower --from-iter"),
        (12, 0, True, r"no iterations; expected iterations after 12.*Raise --iterations\.$"),
    ],
    ids=["never", "never, resumed", "resumed at its end"],
)
def test_a_run_that_could_not_learn_is_refused_before_it_begins(
    photographs, tmp_path, checkpoint, stage, iterations, from_iter, resumed, words
):
    more = ["--start_checkpoint", checkpoint] if resumed else []
    options = RunOptions(stage=stage, from_iter=from_iter, device="cpu")
    with pytest.raises(UsageError, match=words):
        run(command(photographs, tmp_path / "out", iterations, *more), options)
    assert not (tmp_path / "out").exists()


def test_a_target_keeps_nothing_of_the_host_for_the_measurement(photographs, tmp_path):
    """Calls that draw views again hold the model, and photographs that are on a GPU."""
    settings = replace(OPTIONS.settings, goal=Fewer(1.5))
    gc.disable()
    try:
        run(command(photographs, tmp_path / "out", 10), replace(OPTIONS, settings=settings))
        kinds = {type(each).__name__ for each in gc.get_objects()}
        assert kinds.isdisjoint({"GaussianModel", "Camera", "Scene"})
    finally:
        gc.enable()


def test_a_model_that_the_host_drops_is_not_kept_alive():
    with running() as host:
        model = host.model(5)
        host.step(model, host.camera(), 1)
        reference = weakref.ref(model)
        del model
        gc.collect()
        assert reference() is None
        assert host.finish().gaussians == 5
