"""Where stage 2 starts: the last file of the host's own training; what starts from stage 2."""

import contextlib
import json
import logging
import os
import shutil
import time
from dataclasses import replace
from functools import partial
from pathlib import Path
from types import SimpleNamespace

import pytest
import torch
from miniatures import runs
from miniatures.vanilla_3dgs import HOST, InterruptAt, running

from fragprune_plugins import Control, Settings
from fragprune_plugins.errors import HostFailed, Interrupted, SidecarError, UsageError
from fragprune_plugins.files import sidecar
from fragprune_plugins.hosts.seams import Role, SeamCall
from fragprune_plugins.injection.launch import RunOptions, run
from fragprune_plugins.plugins.loading import installed
from fragprune_vanilla_3dgs import Vanilla3DGS

command = partial(runs.command, HOST / "train.py")
SETTINGS = Settings(iterations=6, threshold_lr=0.3, train="opacity")
OPTIONS = RunOptions(device="cpu", settings=SETTINGS)
FINETUNE, OFF = (replace(OPTIONS, stage=stage) for stage in ("finetune", "off"))
CONTROL = replace(FINETUNE, settings=replace(SETTINGS, goal=Control()))


def ply(iteration):
    return Path("point_cloud") / f"iteration_{iteration}" / "point_cloud.ply"


@pytest.fixture(scope="module")
def once(photographs, tmp_path_factory):
    """Stage 1 of ten iterations with a checkpoint at its end, and six of stage 2."""
    out = tmp_path_factory.mktemp("once")
    run(command(photographs, out, 10), OPTIONS)
    return out


@pytest.fixture
def out(once, tmp_path):
    return Path(shutil.copytree(once, tmp_path / "out"))


@pytest.fixture
def started(photographs, caplog):
    """Run, and tell what stage 2 says that it starts from."""

    def start(out, iterations, *more, options=FINETUNE):
        caplog.clear()
        with caplog.at_level(logging.INFO, logger="fragprune"):
            run(command(photographs, out, iterations, *more), options)
        (line,) = [r.getMessage() for r in caplog.records if r.getMessage().startswith("stage 2:")]
        return line

    return start


def test_results_do_not_compound_run_after_run_which_says_what_it_takes(out, started):
    first = (out / ply(17)).read_bytes()
    for newer, more in ((1, ("--checkpoint_iterations", 13)), (2, ())):
        assert started(out, 10, *more) == (
            f"stage 2: 6 iterations from iteration 10, {out / 'chkpnt10.pth'}: the last file "
            f"that the host's own training wrote; newer files of stage 2 ignored: {newer}"
        )
        assert (out / ply(17)).read_bytes() == first
        assert not (out / ply(24)).exists()
    assert (out / "chkpnt13.pth").exists()
    assert f"iteration 10, {out / 'chkpnt10.pth'}:" in started(out, 17)  # as long as the result


def test_after_a_control_stage_two_starts_where_the_control_did(out, started):
    for _ in range(2):  # the second control is one as well
        assert f"iteration 10, {out / 'chkpnt10.pth'}:" in started(out, 10, options=CONTROL)
        assert sidecar.load(out / "control" / ply(17))[0].neutral
    assert f"iteration 10, {out / 'chkpnt10.pth'}:" in started(out, 10)


def test_what_a_control_wrote_is_no_starting_point_in_its_own_folder(photographs, out, started):
    started(out, 10, "--checkpoint_iterations", 13, options=CONTROL)
    assert (out / "control" / "chkpnt13.pth").exists()
    with pytest.raises(UsageError, match="only results of stage 2 or of a control"):
        run(command(photographs, out / "control", 10), FINETUNE)


def test_training_again_for_less_in_one_folder_is_what_counts(photographs, out, started, caplog):
    run(command(photographs, out, 7), OFF)
    assert f"iteration 7, {out / ply(7)}:" in started(out, 7)
    (warning,) = [r.getMessage() for r in caplog.records if r.levelname == "WARNING"]
    assert str(out / "chkpnt10.pth") in warning
    assert "--start_checkpoint" in warning


def test_training_again_as_long_leaves_an_old_checkpoint_behind(photographs, out, started):
    run(command(photographs, out, 10), OFF)
    assert f"iteration 10, {out / ply(10)}:" in started(out, 10)


def test_training_again_over_a_result_of_stage_two_makes_it_stage_ones(photographs, out, started):
    stale = sidecar.path_beside(out / ply(17))
    thresholds = stale.read_bytes()
    run(command(photographs, out, 17), OFF)
    assert not stale.exists()
    stale.write_bytes(thresholds)  # as if the host had trained alone
    with pytest.raises(SidecarError, match="thresholds of another model"):
        started(out, 17)
    stale.unlink()
    assert f"iteration 17, {out / ply(17)}:" in started(out, 17)


@pytest.mark.usefixtures("ctrl_c")
@pytest.mark.parametrize("stage", ["joint", "finetune"])
@pytest.mark.parametrize("earlier", [True, False], ids=["an older checkpoint", "its own PLY"])
@pytest.mark.parametrize("last", [10, 9], ids=["whole", "interrupted"])
def test_after_a_training_that_learned_midway_no_older_file_is_taken_in_its_place(
    photographs, out, started, tmp_path, plug, stage, earlier, last
):
    folder = out if earlier else tmp_path / "joint"
    kind = "--checkpoint_iterations" if earlier else "--save_iterations"
    words = command(photographs, folder, 10, kind, 4, last)
    if last < 10:
        plug(InterruptAt(last if stage == "joint" else last - 6))
    with pytest.raises(Interrupted) if last < 10 else contextlib.nullcontext():
        run(words, replace(OPTIONS, stage=stage, from_iter=6))
    installed.cache_clear()
    assert sidecar.belongs(folder / ply(last))
    for iterations in (10, 12):
        with pytest.raises(UsageError, match=f"a joint training's and older files in {folder}"):
            started(folder, iterations)
    line = started(folder, 10, "--start_checkpoint", folder / ply(last))
    assert f"{folder / ply(last)}: the command names it" in line


def test_a_later_ply_goes_before_an_early_checkpoint(photographs, tmp_path, started):
    words = command(photographs, tmp_path, 10, "--checkpoint_iterations", 5)
    run(words, OFF)
    assert f"{tmp_path / ply(10)}:" in started(tmp_path, 10)


def test_what_the_command_names_is_taken_also_of_stage_two(out, started):
    learned = sidecar.load(out / ply(17))[0].steps
    line = started(out, 10, "--start_checkpoint", out / ply(17))
    assert line.endswith(f"iteration 17, {out / ply(17)}: the command names it")
    assert sidecar.load(out / ply(24))[0].steps == 2 * learned
    started(out, 10, "--checkpoint_iterations", 13)
    line = started(out, 10, "--start_checkpoint", out / "chkpnt13.pth")
    assert line.endswith(f"iteration 13, {out / 'chkpnt13.pth'}: the command names it")
    assert sidecar.load(out / ply(20))[0].steps == 3 + learned


def test_a_training_that_was_broken_off_is_ended_before_stage_two(photographs, out, started):
    words = ("--checkpoint_iterations", 5)
    run(command(photographs, out, 10, *words), OFF)
    named = ("--start_checkpoint", out / "chkpnt5.pth")
    line = started(out, 10, *named, options=OPTIONS)
    assert line.endswith(f"iteration 10, {out / 'chkpnt10.pth'}: the end of stage 1")
    assert "iteration 5," in started(out, 10, *named)  # stage 2 alone
    assert f"iteration 10, {out / 'chkpnt10.pth'}:" in started(out, 10, *named, options=CONTROL)
    for ended in ("chkpnt10.pth", ply(10)):
        line = started(out, 10, "--start_checkpoint", out / ended, options=OPTIONS)
        assert line.endswith(f"iteration 10, {out / ended}: the command names it")
    started(out, 10, "--checkpoint_iterations", 13)
    named = ("--start_checkpoint", out / "chkpnt13.pth")
    assert "iteration 13," in started(out, 30, *named, options=OPTIONS)  # of stage 2


def test_a_ply_whose_folder_tells_no_iteration_is_a_usage_error(photographs, out):
    alone = shutil.copy(out / ply(10), out / "alone.ply")
    for named in (alone, out / "nowhere.ply"):
        with pytest.raises(UsageError, match=r"iteration_N/point_cloud\.ply"):
            run(command(photographs, out, 10, "--start_checkpoint", named), FINETUNE)


def test_a_folder_with_nothing_of_stage_one_says_how_to_go_on(photographs, out):
    (out / "chkpnt10.pth").unlink()
    shutil.rmtree(out / ply(10).parent)
    with pytest.raises(UsageError, match="only results of stage 2") as caught:
        run(command(photographs, out, 10), FINETUNE)
    assert "--start_checkpoint" in caught.value.remedy


NAMES = ("xyz", "f_dc", "f_rest", "scaling", "rotation", "opacity")


def parameters(checkpoint):
    capture, _ = torch.load(checkpoint, weights_only=False)
    return dict(zip(NAMES, capture[1:7], strict=True))


def rates(checkpoint):
    groups = torch.load(checkpoint, weights_only=False)[0][10]["param_groups"]
    return {group["name"]: group["lr"] for group in groups if group["name"] != "xyz"}


def moved(before, after):
    one, other = parameters(before), parameters(after)
    return {name for name in NAMES if not torch.equal(one[name], other[name])}


@pytest.fixture(scope="module")
def trained(photographs, tmp_path_factory):
    """Twelve iterations and six of stage 2; checkpoints of iterations 12 and 16."""
    out = tmp_path_factory.mktemp("trained")
    run(command(photographs, out, 12, "--checkpoint_iterations", 16), OPTIONS)
    assert moved(out / "chkpnt12.pth", out / "chkpnt16.pth") == {"opacity"}
    return out


@pytest.mark.parametrize("stage", ["off", "joint", "finetune"])
def test_from_a_checkpoint_of_stage_two_all_trains_again(photographs, trained, tmp_path, stage):
    start, out = trained / "chkpnt16.pth", tmp_path / "out"
    more = ["--start_checkpoint", start, "--checkpoint_iterations", 21]
    settings = replace(SETTINGS, train="all")
    words = command(photographs, out, 22, *more)
    run(words, replace(OPTIONS, stage=stage, settings=settings))
    # a second band comes much later
    assert moved(start, out / "chkpnt21.pth") == set(NAMES) - {"f_rest"}


def test_a_stage_two_from_a_ply_writes_checkpoints_of_the_host(photographs, trained, tmp_path):
    (tmp_path / ply(12)).parent.mkdir(parents=True)
    shutil.copy(trained / ply(12), tmp_path / ply(12))
    words = command(photographs, tmp_path, 12, "--checkpoint_iterations", 16)
    run(words, FINETUNE)
    assert all(p.requires_grad for p in parameters(tmp_path / "chkpnt16.pth").values())
    assert rates(tmp_path / "chkpnt16.pth") == rates(trained / "chkpnt12.pth")


def test_stage_two_takes_no_earlier_runs_checkpoint_for_its_own(photographs, out, tmp_path):
    """Hosts refuse with exit code 0 too, and the folder holds what they should have written."""
    words = command(photographs, out, 10)
    host = Path(shutil.copytree(HOST, tmp_path / "host"))
    script = host / "train.py"
    script.write_text("raise SystemExit(0)\n" + script.read_text())
    with pytest.raises(HostFailed, match="without a checkpoint of iteration 10"):
        run([str(script), *words[1:]], OPTIONS)


def test_a_checkpoint_that_we_made_comes_to_the_gpu_of_its_model():
    """Hosts load one to where it was saved; there "meta" stands for a GPU."""
    with running() as host:
        model, arguments = host.model(), host.arguments
        host.step(model, host.camera(), 1)
        made = model.capture()
        for name, each in vars(model).items():
            if isinstance(each, torch.nn.Parameter):
                setattr(model, name, torch.nn.Parameter(each.to("meta")))
        model.restore(made, arguments)
        parameters = [group["params"][0] for group in model.optimizer.param_groups]
        assert {each.device.type for each in parameters} == {"meta"}
        assert all(each.is_leaf and each.requires_grad for each in parameters)
        assert {each.device.type for each in (model.denom, model.max_radii2D)} == {"meta"}
        moments = model.optimizer.state[model._xyz]
        assert [moments[k].device.type for k in ("exp_avg", "step")] == ["meta", "cpu"]


@pytest.mark.parametrize("named", ["chkpnt10.pth", ply(10)])
def test_the_model_of_before_lies_where_the_named_start_does(photographs, out, tmp_path, named):
    """The command's own folder holds no model of that iteration, or another training's."""
    other, new = tmp_path / "other", tmp_path / "new"
    run(command(photographs, other, 10, "--lambda_dssim", 0.9), OFF)
    for folder in (other, new):
        words = command(photographs, folder, 10, "--start_checkpoint", out / named)
        summary = run(words, FINETUNE)
        assert (summary.model_before, summary.not_compared) == (out / ply(10), None)


def test_exposures_are_those_of_the_start_also_after_stage_two(tmp_path):
    """The host saves them in one file of the folder, which stage 2 writes anew."""
    starts = [tmp_path / "chkpnt10.pth", tmp_path / ply(10)]

    def begun(gain, start):
        rows = {"view": (gain * torch.eye(3, 4)).tolist()}
        (tmp_path / "exposure.json").write_text(json.dumps(rows))
        model = SimpleNamespace(exposure_mapping={"view": 0}, _exposure=torch.eye(3, 4)[None])
        Vanilla3DGS().prepare_stage2(model, start)
        return float(model._exposure[0, 0, 0])

    def shown():
        model = SimpleNamespace(pretrained_exposures={"view": torch.eye(3, 4)})
        load = next(seam for seam in Vanilla3DGS.seams if seam.role is Role.LOAD)
        call = SeamCall(load, lambda path: None, model, (str(starts[1]),), {})
        call.model = model
        assert call.how() == starts[1]
        return float(model.pretrained_exposures["view"][0, 0])

    starts[1].parent.mkdir(parents=True)
    for each in starts:
        each.touch()
    assert shown() == 1.0
    assert [begun(gain, starts[gain % 2]) for gain in (2, 3, 4)] == [2.0, 2.0, 2.0]
    assert shown() == 2.0
    later = time.time() + 9
    os.utime(starts[1], (later, later))  # trained again
    assert shown() == 1.0
    assert begun(5, starts[0]) == 5.0


def test_exposures_are_restored_beside_a_checkpoint_of_any_name(tmp_path):
    (tmp_path / "exposure.json").write_text(json.dumps({"a": (2 * torch.eye(3, 4)).tolist()}))
    model = SimpleNamespace(exposure_mapping={"a": 0}, _exposure=torch.eye(3, 4)[None])
    Vanilla3DGS().prepare_stage2(model, tmp_path / "final.pth")
    assert torch.equal(model._exposure[0], 2 * torch.eye(3, 4))
