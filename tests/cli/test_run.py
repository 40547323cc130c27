"""fragprune run, on a small host: what is said of its result, and how it is compared."""

import importlib
import json
import logging
import shutil
from unittest.mock import Mock

import pytest
import torch
from cli.commands import fails, run, run_json, succeeds
from miniatures.runs import TINY, edit
from miniatures.vanilla_3dgs import HOST

from fragprune_plugins import load
from fragprune_plugins.adapting import ModelFileError, UsageError
from fragprune_plugins.errors import OutputError
from fragprune_plugins.files import sidecar
from fragprune_plugins.files.atomic import in_flight, locked
from fragprune_plugins.injection import launch
from fragprune_plugins.learning.schedule import USUAL_STOP
from fragprune_plugins.workbench.figures import records
from fragprune_plugins.workbench.figures.wording import begun
from fragprune_plugins.workbench.finetune import relocation, trial
from fragprune_plugins.workbench.finetune.loop import LIVELY
from fragprune_plugins.workbench.finetune.relocation import PACE, SHARE, least
from fragprune_plugins.workbench.pruning import kept
from fragprune_plugins.workbench.run import work

WORDS = ["--device", "cpu", "--iters", 6]


@pytest.fixture(scope="module")
def scene(photographs):
    return photographs


def models(out):
    return [out / f"point_cloud/iteration_{i}/point_cloud.ply" for i in (10, 17)]


def command(scene, out, *more, host=HOST):
    words = ["-s", scene, "-m", out, "--iterations", 10, *TINY, *more]
    return ["--", host / "train.py", *words]


@pytest.fixture(scope="module")
def trained(scene, tmp_path_factory):
    """A run with half the sides asked for, and what it printed."""
    out = tmp_path_factory.mktemp("trained") / "out"
    return out, run_json("run", *WORDS, *command(scene, out, "-r", 2)), scene


@pytest.fixture
def folder(trained, tmp_path):
    """Such a run, and the words of the host's command."""
    out = shutil.copytree(trained[0], tmp_path / "out")
    return out, command(trained[2], out, "-r", 2)


@pytest.fixture
def host(tmp_path):
    """The host, to be changed."""
    return shutil.copytree(HOST, tmp_path / "host")


def test_the_line_has_frame_times_and_says_that_no_control_was_run(scene, tmp_path, caplog):
    caplog.set_level(logging.INFO, logger="fragprune")
    result = run("run", *WORDS, *command(scene, tmp_path / "out"))
    assert caplog.text.count("nothing is proved") == 1  # not once in each stage
    assert result.exit_code == 0, result.stderr
    (line,) = (line for line in result.stdout.splitlines() if " per pixel), frames " in line)
    assert " ms (" in line
    assert "no control was found; to see, add --stage finetune --control" in line


def test_a_host_trains_with_the_usual_stop_and_its_model_keeps_it(trained):
    _, found, _ = trained
    assert load(found["model_before"]).stop is None
    assert load(found["model_after"]).stop == USUAL_STOP


def test_two_trainings_into_one_folder_at_once_are_refused_and_a_dead_ones_lock_is_not(
    folder, tmp_path
):
    (out, words), left = folder, in_flight(tmp_path / "out", "run")
    finetune = ["--stage", "finetune", *WORDS]
    with locked(out, wait=0, what="run"):
        fails("run", *finetune, *words, says=(str(out), "another process"), code=1)
        assert run("run", *finetune, "--control", *words).exit_code == 0  # into its own folder
    left.touch()  # as a killed process leaves it
    succeeds("run", *finetune, *words)
    assert not left.exists()


@pytest.mark.parametrize(("words", "threads"), [([], 1), (["--threads", 3], 3)])
def test_the_host_takes_as_many_threads_as_it_is_given(words, threads, monkeypatch):
    def launched(*_):
        raise UsageError("host", f"{torch.get_num_threads()} threads", "a look", "Nothing.")

    monkeypatch.setattr(launch, "run", launched)
    fails("run", *words, "--", HOST / "train.py", says=f"{threads} threads")


@pytest.mark.parametrize(
    ("name", "beside", "shown"),
    [
        ("point_cloud.ply", (), True),
        ("point_cloud.ply", ("deformation.pth",), False),  # 4DGaussians
        ("chkpnt16.pth", (), False),  # RT-4DGS
    ],
)
def test_a_page_is_advised_where_view_shows(name, beside, shown, trained, tmp_path, monkeypatch):
    found, model = trained[1], tmp_path / name
    shutil.copy(found["model_after"], model)
    shutil.copy(sidecar.path_beside(found["model_after"]), sidecar.path_beside(model))
    for each in beside:
        (tmp_path / each).touch()
    summary = launch.RunSummary(
        **{"adapter": "a host", "engine": "cpu", "device": "cpu", "stage": "finetune"},
        **{"fragments_before": 2.0, "fragments_after": 1.0, "train_seconds": 1.0, "curves": []},
        **{"steps": 6, "gaussians": found["gaussians"], "settings": found["settings"]},
        **{"model_after": model, "output": tmp_path},
    )
    monkeypatch.setattr(launch, "run", lambda *_: summary)
    said = run("run", "--", HOST / "train.py").stdout
    assert (f"fragprune view {model}" in said) == shown
    assert (f"fragprune export {model} --out pruned.ply" in said) == shown
    assert f"fragprune report {tmp_path}" in said


@pytest.mark.parametrize(
    "learning",
    [("--stage", "joint", "--from-iter", 12), ("--stage", "finetune", "--from-iter", 12)],
    ids=["joint", "one run"],
)
def test_a_control_inside_one_training_lies_beside_the_result_too(scene, tmp_path, learning):
    out = tmp_path / "out"
    words = ["--device", "cpu", *learning]
    training = command(scene, out, "--iterations", 16)
    run_json("run", *words, *training)
    kept = {path: path.read_bytes() for path in out.rglob("*") if path.is_file()}
    zero = run("run", *words, "--control", *training)
    assert f"Model: {out / 'control'}" in zero.stdout
    assert {path: path.read_bytes() for path in kept} == kept
    assert "fragprune compare" not in zero.stdout  # there is no second model


def test_compare_is_advised_of_nothing_that_was_not_measured(folder):
    out, words = folder
    (record,) = records.find(out)
    records.leave(models(out)[1], "run", record.data | {"before": None})
    result = run("run", "--stage", "finetune", *WORDS, *words)
    assert "is finished" in result.stdout
    assert "fragprune compare" not in result.stdout


def test_a_control_lies_beside_the_result_and_is_quoted_with_it(folder):
    (out, words), finetune = folder, ["--stage", "finetune", *WORDS]
    kept = {path: path.read_bytes() for path in out.rglob("*") if path.is_file()}
    zero = succeeds("run", *finetune, "--control", *words)
    assert zero.stdout.split("\n")[0].split() == ["original", "control", "change"]
    run("report", out / "control")
    page = (out / "control/report.html").read_text()
    assert '<th scope="col">control' in page
    assert ">pruned<" not in page
    assert {path: path.read_bytes() for path in kept} == kept
    assert "pruning itself makes" in run("run", *finetune, *words).stdout
    again = run_json("run", *finetune, "--again", *words)
    assert again["control"] == records.find(out / "control")[0].data["after"]
    assert "pruning itself makes" in run_json("report", out)["result"]
    other = run_json("run", *finetune, "--again", *words, "--lambda_dssim", 0.5)
    assert other["control"] is None  # of another loss


MOVED = ("point_cloud.fragprune.safetensors is not beside it", "there is ")


@pytest.mark.parametrize(
    ("files", "tidied", "said"),
    [
        ("*.safetensors", "each.rename(Path(args.model_path, each.name))", MOVED),
        ("point_cloud.*", "each.unlink()", ("no model was saved", "last iteration")),
    ],
)
def test_what_a_host_that_tidies_up_takes_away_is_missed(
    scene, host, tmp_path, files, tidied, said
):
    with (host / "train.py").open("a") as script:
        script.write("    from pathlib import Path\n")
        script.write(f"    for each in Path(args.model_path).rglob('{files}'): {tidied}\n")
    fails("run", *WORDS, *command(scene, tmp_path / "out", host=host), says=said, code=1)


def test_a_host_prints_in_every_process_of_several(scene, host, tmp_path, monkeypatch):
    """Fine-tuning and rendering share their work, and print in the first: no other command does."""
    with (host / "train.py").open("a") as script:
        script.write("    print('trained by', os.environ['RANK'])\n")
    edit(host / "train.py", "import sys\n", "import os\nimport sys\n")
    monkeypatch.setenv("WORLD_SIZE", "2")
    monkeypatch.setenv("RANK", "1")
    words = command(scene, tmp_path / "out", host=host)
    assert "trained by 1" in run("run", "--device", "cpu", "--stage", "off", *words).stdout


@pytest.mark.parametrize("last", [10, 14])
def test_a_stage_two_that_a_host_cuts_short_is_told(scene, host, tmp_path, last, caplog):
    edit(host / "train.py", "opt.iterations + 1", f"min(opt.iterations, {last}) + 1")
    words = command(scene, tmp_path / "out", host=host)
    if last == 10:
        fails("run", *WORDS, *words, says="0 of 6 iterations", code=1)
    else:
        run("run", *WORDS, *words)
        assert "ended after 4 of 6 iterations" in caplog.text


@pytest.mark.parametrize("stage", ["joint", "finetune"])
def test_iterations_of_one_training_that_teach_nothing_are_told(
    scene, host, tmp_path, stage, caplog
):
    """A host that sets no rate any more counts no step, and nothing is pressed upon."""
    rate = "gaussians.update_learning_rate(iteration)"
    edit(host / "train.py", rate, f"{rate} if iteration < 14 else None")
    words = command(scene, tmp_path / "out", "--iterations", 20, host=host)
    run("run", "--device", "cpu", "--stage", stage, "--from-iter", 10, *words)
    assert "learned in 3 of 9 iterations" in caplog.text


@pytest.mark.parametrize("held", [True, False])
def test_views_that_stage_one_saw_are_not_said_to_be_held_out(scene, tmp_path, held):
    out = tmp_path / "out"
    words = command(scene, out, "--densify_until_iter", 8)
    first = [word for word in words if held or word != "--eval"]
    run_json("run", "--stage", "off", *WORDS, *first)
    line = run("run", "--stage", "finetune", *WORDS, *words).stdout
    assert (" held out" in line) == held
    assert ("that its training had seen" in line) != held
    assert (" held out" in run_json("report", out)["result"]) == held


def test_where_the_code_leaves_it_open_the_model_says_which_principal_point_it_has(
    tmp_path, host, scene
):
    """A host reads the scene's own point by an option: without it, it takes the middle."""
    scene = shutil.copytree(scene, tmp_path / "scene")
    cameras = scene / "sparse" / "0" / "cameras.txt"
    *lens, _, _ = cameras.read_text().splitlines()[-1].split()
    cameras.write_text(" ".join([*lens, str(0.6 * int(lens[2])), str(0.4 * int(lens[3]))]))
    with (host / "scene" / "cameras.py").open("a") as source:
        source.write("\n\ndef own(c):\n    getProjectionMatrix(1, 9, c.FoVx, c.FoVy, cx=c.cx)\n")
    assert run_json("run", *WORDS, *command(scene, tmp_path / "out", host=host))["after"]
    assert records.recorded(records.find(tmp_path / "out")[-1]).photographs.centred


def test_a_finished_stage_two_says_so_and_runs_nothing(folder):
    (out, words), finetune = folder, ["--stage", "finetune", *WORDS]
    result = models(out)[1]
    written = result.stat().st_mtime_ns
    report = run_json("run", *finetune, *words)
    assert report["already_finished"] is True
    assert (report["iterations"], report["model_after"]) == (0, str(result))
    text = succeeds("run", *finetune, *words)
    assert "is finished" in text.stdout
    assert f"fragprune compare {models(out)[0]} {result}" in text.stdout
    (known,) = (each for each in records.find(out) if each.path.parent == result.parent)
    known.path.unlink()  # as after Ctrl-C while it measures
    assert run_json("run", *finetune, *words)["after"]["psnr"] == known.data["after"]["psnr"]
    measured = records.beside(result).data
    for key in ("iterations", "settings", "gaussians"):
        assert measured[key] == known.data[key]
    assert result.stat().st_mtime_ns == written
    assert run_json("run", *finetune, "--pressure", 2e-3, *words)["already_finished"] is False
    other = run_json("run", *finetune, "--pressure", 2e-3, *words, "--lambda_dssim", 0.5)
    assert other["already_finished"] is False


def test_a_model_that_knows_photographs_by_heart_is_told(scene, tmp_path, monkeypatch):
    out = tmp_path / "out"
    words = command(scene, out, "--densify_until_iter", 8)
    monkeypatch.setattr(trial, "forgotten", lambda *_, **__: trial.BY_HEART)
    result = succeeds("run", *WORDS, *words)
    whole = len(load(models(out)[0]))
    kept = len(load(models(out)[1]))
    assert kept == round(whole * trial.KEEP)
    assert f"Removed {whole - kept} of {whole} Gaussians before learning" in result.stdout
    assert f"learned with --dropout {trial.DROPOUT:g}" in result.stdout
    (record,) = records.find(out)
    assert (record.data["keep"], record.data["forgotten"]) == (trial.KEEP, trial.BY_HEART)
    assert record.data["settings"]["dropout"] == trial.DROPOUT
    asked = run_json("run", "--stage", "finetune", "--dropout", 0, *WORDS, *words)
    assert (asked["gaussians"], asked["keep"], asked["forgotten"]) == (whole, None, None)


NAMES = ("xyz", "f_dc", "f_rest", "opacity", "scaling", "rotation")  # vanilla's order of groups


def rates_of(monkeypatch, *words, names=NAMES):
    """What a run reports, and the rates of its first step, which takes these in their order."""
    module = importlib.import_module("torch.optim.adam")  # a function hides it
    seen, adam = [], module.adam

    def noted(*args, lr, **kwargs):
        seen.append(lr)
        return adam(*args, lr=lr, **kwargs)

    with monkeypatch.context() as patch:
        patch.setattr(module, "adam", noted)
        data = run_json("run", "--device", "cpu", "--stage", "finetune", "--iters", 40, *words)
    return data, dict(zip(names, seen, strict=False))


@pytest.mark.parametrize("forgotten", [0.0, trial.BY_HEART])
def test_stage_two_is_as_lively_as_a_fine_tuning(folder, monkeypatch, forgotten):
    out, words = folder
    monkeypatch.setattr(trial, "forgotten", lambda *_, **__: forgotten)
    stays, moving = [], []
    monkeypatch.setattr(work, "kept", lambda *a, **b: stays.append(kept(*a, **b)) or stays[-1])
    monkeypatch.setattr(work, "least", lambda scores: moving.append(least(scores)) or moving[-1])
    _, usual = rates_of(monkeypatch, "--control", *words)
    data, lively = rates_of(monkeypatch, *words)
    for name in ("f_dc", "f_rest", "scaling", "rotation"):
        assert lively[name] == pytest.approx(LIVELY * usual[name]), name
    assert lively["opacity"] == usual["opacity"]
    if forgotten:
        assert data["relocated"] == 0
        assert not moving
        return
    first = load(models(out)[0]).keep(stays[0])
    assert lively["xyz"] == pytest.approx(PACE * float(first.scaling.exp().amax(1).median()))
    (rows,) = moving
    assert data["relocated"] == len(rows) == int(SHARE * data["gaussians"]) > 0
    assert any(each.startswith(f"Moved {len(rows)}") for each in begun(data))
    after = load(data["model_after"])
    assert len(after.thresholds) == len(after) == data["gaussians"]


def test_area_has_a_price_while_gaussians_move(folder, monkeypatch):
    monkeypatch.setattr(trial, "forgotten", lambda *_, **__: 0.0)
    areas = []
    for price in 0.0, 1.0:
        monkeypatch.setattr(relocation, "COMPACT", price)
        data, _ = rates_of(monkeypatch, "--again", *folder[1])
        areas.append(data["after"]["area_per_pixel"])
    assert areas[1] < 0.95 * areas[0]  # of ten of the 40 steps


def test_a_host_with_two_optimizers_is_as_lively(folder, scene, host, monkeypatch):
    setup = "        self.optimizer = torch.optim.Adam(groups, lr=0.0, eps=1e-15)\n"
    apart = "        self.shs = torch.optim.Adam([groups.pop(2)], lr=0.0, eps=1e-15)\n"
    edit(host / "scene/gaussian_model.py", setup, apart + setup)
    step = "                gaussians.optimizer.step()\n"
    edit(host / "train.py", step, step + step.replace("optimizer", "shs"))
    words = command(scene, folder[0] / "anew", "-r", 2, "--densify_until_iter", 0, host=host)
    words += ["--checkpoint_iterations", 10]  # from its PLY, ours has the groups of one
    run_json("run", "--device", "cpu", "--stage", "off", *words)
    monkeypatch.setattr(trial, "forgotten", lambda *_, **__: 0.0)
    names = ("xyz", "f_dc", "opacity", "scaling", "rotation", "thresholds", "f_rest")
    data, lively = rates_of(monkeypatch, *words, names=names)
    assert data["relocated"] > 0
    assert lively["rotation"] == pytest.approx(LIVELY * 0.001)
    assert lively["f_rest"] == pytest.approx(LIVELY * 0.0025 / 20)


def test_rates_are_lent_for_a_step_alone(folder, scene, host, monkeypatch):
    """The host saves its rates in its checkpoints."""
    out = folder[0]
    step = "                gaussians.optimizer.step()\n"
    noted = (
        "                torch.save([g['lr'] for g in gaussians.optimizer.param_groups], RATES)\n"
    )
    edit(host / "train.py", step, step + noted.replace("RATES", repr(str(out / "rates.pt"))))
    monkeypatch.setattr(trial, "forgotten", lambda *_, **__: 0.0)
    words, after = command(scene, out, "-r", 2, host=host), []
    for more in ("--control",), ():
        data, _ = rates_of(monkeypatch, *more, *words)
        after.append(torch.load(out / "rates.pt"))
    assert data["relocated"] > 0
    assert after[0] == after[1]


def test_gaussians_with_a_label_of_the_hosts_own_stay_where_they_are(
    folder, scene, host, monkeypatch
):
    named = "        self.percent_dense = training_args.percent_dense\n"
    label = "        self.label = torch.arange(len(self._xyz))\n"
    edit(host / "scene/gaussian_model.py", named, named + label)
    monkeypatch.setattr(trial, "forgotten", lambda *_, **__: 0.0)
    words = command(scene, folder[0], "-r", 2, host=host)
    _, usual = rates_of(monkeypatch, "--control", *words)
    data, own = rates_of(monkeypatch, *words)
    assert data["relocated"] == 0
    assert own == usual


FULL = torch.cuda.OutOfMemoryError("CUDA out of memory. Tried to allocate 2.00 GiB.")


@pytest.mark.parametrize(
    ("where", "error"),
    [
        ((trial, "forgotten"), FULL),
        ((work, "kept"), ModelFileError("out", "a stand-in", "another", "Nothing.")),
    ],
)
def test_where_a_look_fails_we_learn_as_asked(scene, tmp_path, monkeypatch, caplog, where, error):
    monkeypatch.setattr(trial, "forgotten", lambda *_, **__: trial.BY_HEART)
    monkeypatch.setattr(*where, Mock(side_effect=error))
    result = succeeds("run", *WORDS, *command(scene, tmp_path / "out", "--densify_until_iter", 8))
    assert "not tried whether it knows its photographs by heart, because of" in caplog.text
    assert "Removed" not in result.stdout
    (record,) = records.find(tmp_path / "out")
    assert (record.data["keep"], record.data["forgotten"]) == (None, None)
    assert record.data["settings"]["dropout"] is None


def test_where_a_gpu_has_no_room_to_measure_the_rest_is_reported(scene, tmp_path, monkeypatch):
    monkeypatch.setattr(work.evaluate, "measure_all", Mock(side_effect=FULL))
    report = run_json("run", *WORDS, *command(scene, tmp_path / "out"))
    assert (report["iterations"], report["after"]) == (6, None)
    assert "Tried to allocate 2.00 GiB" in report["not_compared"]["found"]
    assert records.find(tmp_path / "out")


def test_figures_are_told_where_their_record_has_no_space(scene, tmp_path, monkeypatch):
    full = OutputError("out", "no space", "a place", "Free some.")
    monkeypatch.setattr(records, "replacing", Mock(side_effect=full))
    result = run("run", "--json", *WORDS, *command(scene, tmp_path / "out"))
    assert result.exit_code == 1
    assert json.loads(result.stdout)["after"]["psnr"] > 0
    assert "point_cloud.ply is written, its record is not: [output]" in result.stderr


def test_compare_follows_the_run_that_left_the_models(trained):
    out, report, scene = trained
    same = run_json("compare", *models(out))
    assert same["scene"]["folder"] == str(scene)
    for side, measured in (("a", report["before"]), ("b", report["after"])):
        for name in ("psnr", "ssim", "fragments_per_pixel"):
            assert same[side][name] == pytest.approx(measured[name], rel=1e-6)
    named = run_json("compare", *models(out), "--data", scene)
    assert named["a"]["psnr"] == same["a"]["psnr"]
    assert ", 20x15 pixels" in run("compare", *models(out)).stdout
    assert ", 40x30 pixels" in run("compare", *models(out), "--resolution", 1).stdout


def test_a_stage_two_that_reads_photographs_otherwise_says_so(scene, tmp_path, caplog):
    out = tmp_path / "out"
    more = ("--densify_until_iter", 8)
    succeeds("run", *WORDS, *command(scene, out, *more, "-w", "-i", "images"))
    assert "its training had another" not in caplog.text
    words = command(scene, out, *more, "-r", 2)
    words.remove("--eval")
    succeeds("run", "--stage", "finetune", *WORDS, *words)
    assert "its training had another resolution, white_background, eval (cfg_args)" in caplog.text


def test_without_eval_every_eighth_view_that_was_trained_on_is_measured(scene, tmp_path):
    words = command(scene, tmp_path / "out", "--densify_until_iter", 8)
    words.remove("--eval")
    said = run("run", *WORDS, *words).stdout
    assert "that its training had seen" in said
    assert "The host held no view out" in said
    (record,) = records.find(tmp_path / "out")
    data = record.data
    assert data["seen"]
    assert data["not_compared"] is None
    assert data["before"]["views"] == data["after"]["views"] == 1
    assert min(data["before"]["frame_ms"], data["after"]["frame_ms"]) > 0
    assert " held out" not in run_json("report", tmp_path / "out")["result"]


def test_without_eval_joint_learning_says_that_its_views_were_seen(scene, tmp_path):
    words = command(scene, tmp_path / "out", "--iterations", 24, "--densify_until_iter", 12)
    words.remove("--eval")
    said = run("run", "--device", "cpu", "--stage", "joint", *words).stdout
    assert "The host held no view out" in said


def test_a_host_that_raises_leaves_one_json_object_on_stdout(host, tmp_path):
    edit(host / "train.py", "import torch\n", "import torch\n1 / 0\n")
    words = ("--", host / "train.py", "-s", tmp_path, "-m", "out")
    result = run("run", "--device", "cpu", "--json", *words)
    assert result.exit_code == 1
    error = json.loads(result.stdout)["error"]
    assert error["code"] == "host-failed"
    assert error["found"] == "ZeroDivisionError: division by zero"
    assert error["where"].startswith("train.py:")
    assert "Traceback (most recent call last)" in result.stderr


def test_joint_learning_is_measured_and_compared_with_another_training(scene, tmp_path):
    out, plain = tmp_path / "out", tmp_path / "plain"
    words = ["--iterations", 24, "--densify_until_iter", 12]
    text = run_json("run", "--device", "cpu", "--stage", "joint", *command(scene, out, *words))
    measured = text["after"]
    assert text["before"] is None
    assert text["iterations"] == text["settings"]["iterations"] == 11  # the host skips its last
    assert measured["psnr"] > 0
    assert text["not_compared"] is None
    run_json("run", "--device", "cpu", "--stage", "off", *command(scene, plain, *words))
    last = "point_cloud/iteration_24/point_cloud.ply"
    same = run_json("compare", plain / last, out / last)
    assert same["b"]["psnr"] == pytest.approx(measured["psnr"], rel=1e-6)
    assert "fragments per pixel drawn" in succeeds("report", out).stdout
