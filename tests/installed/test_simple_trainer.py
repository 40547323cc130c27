"""``fragprune run`` with gsplat's own training script: a small one with its interface."""

import contextlib
import json
import re
import shutil
from dataclasses import replace
from pathlib import Path

import pytest
import torch
from installed.gsplat_host import releases
from miniatures.datasets.colmap import WORLD

from fragprune_gsplat import Gsplat
from fragprune_gsplat.trainer import SimpleTrainer
from fragprune_plugins import Control, Pressure, Settings
from fragprune_plugins.adapting import HostRepo, Photographs
from fragprune_plugins.errors import EngineError, NotComparedError, SidecarError, UsageError
from fragprune_plugins.files import sidecar
from fragprune_plugins.injection import starting, stepping
from fragprune_plugins.injection.launch import RunOptions, run
from fragprune_plugins.learning.stage2 import Stage2
from fragprune_plugins.plugins.loading import installed
from fragprune_plugins.workbench.models.model import load
from fragprune_plugins.workbench.run.lively import Lively

SCRIPT = Path(__file__).parents[1] / "miniatures" / "simple_trainer.py"
RELEASES = releases()
TOTAL, MORE = 24, 6
adapter, repo = SimpleTrainer(SCRIPT), HostRepo.installed("gsplat")


@pytest.fixture(params=RELEASES.values(), ids=RELEASES.keys())
def release(request, monkeypatch):
    """Each gsplat that is here, in front of the installed one."""
    monkeypatch.syspath_prepend(request.param)


@pytest.fixture
def train(tmp_path):
    """``train(*words, stage=...)``: the script's command."""

    def command(*words, strategy="default", settings=None, ply=False, **options):
        settings = settings or Settings(iterations=MORE, threshold_lr=0.5, goal=Pressure(1e-2))
        line = [str(SCRIPT), strategy, "--data_dir", str(tmp_path)]
        line += ["--result_dir", str(tmp_path / "out"), "--max_steps", str(TOTAL), *map(str, words)]
        line += [] if ply else ["--no-save-ply"]
        return run(line, RunOptions(device="cpu", settings=settings, **options))

    return command


def checkpoint(folder, iteration):
    return folder / "ckpts" / f"ckpt_{iteration - 1}_rank0.pt"


def evaluated(folder, iteration):
    return json.loads((folder / "stats" / f"val_step{iteration - 1:04d}.json").read_text())


@pytest.mark.parametrize("strategy", ["default", "mcmc"])
def test_stage_two_follows_the_training_in_one_longer_run(release, train, tmp_path, strategy):
    out = tmp_path / "out"
    summary = train("--save-steps", 3, strategy=strategy)
    assert (summary.steps, len(summary.curves)) == (MORE, MORE)
    first, last = checkpoint(out, TOTAL), checkpoint(out, TOTAL + MORE)
    assert (summary.model_before, summary.model_after) == (first, last)
    assert {*out.glob("ckpts/*.pt")} == {checkpoint(out, 3), first, last}
    assert summary.fragments_after < summary.fragments_before
    before, after = (torch.load(path)["splats"] for path in (first, last))
    assert len(before["means"]) == len(after["means"]) != 60  # refined until then, not since
    assert not torch.equal(before["means"], after["means"])
    store, info = sidecar.load(last, len(after["means"]))
    assert (info.adapter, store.steps) == ("gsplat", MORE - 1)  # saved before the last step
    assert not sidecar.path_beside(first).exists()
    assert {evaluated(out, at)["num_GS"] for at in (TOTAL, TOTAL + MORE)} == {summary.gaussians}


def test_ctrl_c_closes_the_viewer_of_a_training_that_is_over(train, tmp_path):
    """It is open by default, and the script says: Ctrl+C to exit."""
    summary = train("--viewer", "open")
    assert summary.steps == MORE
    assert summary.model_after == checkpoint(tmp_path / "out", TOTAL + MORE)
    assert sidecar.load(summary.model_after)[0].steps == MORE - 1  # the script's own, as it was


def test_an_evaluation_draws_with_the_thresholds_beside_its_checkpoint(release, train, tmp_path):
    out, last = tmp_path / "out", checkpoint(tmp_path / "out", TOTAL + MORE)
    train("--eval_steps", 3)
    seen = []
    for truncated in (True, False):
        if not truncated:
            sidecar.path_beside(last).unlink()
        (out / "stats" / f"val_step{TOTAL + MORE - 1:04d}.json").unlink()
        assert train("--ckpt", last).steps == 0
        seen.append(evaluated(out, TOTAL + MORE)["mean"])
    assert seen[0] < seen[1]  # what is truncated is missing on black
    train()
    shutil.copy(checkpoint(out, TOTAL), last)
    with pytest.raises(SidecarError, match="another"):
        train("--ckpt", last)


def test_the_control_has_a_folder_of_its_own(train, tmp_path):
    summary = train(settings=Settings(iterations=MORE, goal=Control()))
    assert summary.model_after == checkpoint(tmp_path / "out" / "control", TOTAL + MORE)
    assert sidecar.load(summary.model_after, summary.gaussians)[0].neutral


def test_joint_learning_begins_where_refinement_ends(train, tmp_path):
    with pytest.raises(UsageError, match="after 15000"):  # by the strategy's own default
        train(stage="joint")
    summary = train(stage="joint", from_iter=4)
    store, _ = sidecar.load(summary.model_after, summary.gaussians)
    assert (summary.steps, len(store)) == (TOTAL - 4, summary.gaussians)


@pytest.mark.parametrize(
    "words",
    [
        *("--steps-scaler 0.5", "--compression png", "--camera_model=fisheye"),
        *("--with_ut --packed", "--strategy.absgrad", "--app_opt"),
    ],
)
def test_flags_that_stage_two_cannot_follow_are_refused_before_the_training(words, train, tmp_path):
    how = {"stage": "auto", "device": "cpu"}
    adapter.refuse(repo, ["default", "--camera-model", "pinhole", "--steps_scaler=1"], **how)
    named = re.split(r"[ =]", words)[0].split(".")[-1].strip("-").replace("_", "-")
    with pytest.raises(UsageError, match=named):
        train(*words.split())
    assert not (tmp_path / "out").exists()


@pytest.mark.parametrize("device", ["cuda", "cuda:1", "cpu"])
@pytest.mark.parametrize("stage", ["auto", "finetune", "joint"])
def test_absolute_gradients_are_for_strategies_that_run_on_a_gpu_before_stage_two(stage, device):
    fine = device != "cpu" and stage != "joint"
    with contextlib.nullcontext() if fine else pytest.raises(UsageError, match="absgrad"):
        adapter.refuse(repo, ["default", "--strategy.absgrad"], stage=stage, device=device)


@pytest.mark.parametrize("normalized", [True, False])
def test_what_the_script_reads_is_known_once_it_saved_a_ply(
    normalized, train, tmp_path, monkeypatch
):
    monkeypatch.chdir(tmp_path)
    more = [] if normalized else ["--no-normalize-world-space"]
    words = ["default", "--data-dir", "in", "--result-dir", "out", *more]
    with pytest.raises(NotComparedError, match="checkpoints alone"):
        adapter.photographs(repo, words)
    how = {"centred": False, "opaque": True}  # the scene's own point; three channels of four
    how["world"] = tuple(map(tuple, WORLD.tolist())) if normalized else None
    read = train(*more, ply=True).photographs
    assert read == Photographs(tmp_path, images="images_4", **how)
    how.pop("world")
    assert adapter.photographs(repo, words) == Photographs(Path("in"), images="images_4", **how)
    whole = adapter.photographs(repo, [*words, "--data_factor=2", "--data_factor", "1"])
    assert whole == Photographs(Path("in"), **how)
    Path("in", "images_4_png").mkdir(parents=True)  # made by the script, of JPEGs
    assert adapter.photographs(repo, words).images == "images_4_png"
    for more, why in {
        ("--test_every", "4"): "every eighth",
        ("--data_type", "ncore"): "another kind",
        ("--use_bilateral_grid",): "bilateral-grid",
        ("--post_processing=ppisp",): "post-processing",
    }.items():
        with pytest.raises(NotComparedError, match=why):
            adapter.photographs(repo, [*words, *more])


class Looked:
    """Keeps every second Gaussian, draws random numbers, and trains a model of its own."""

    def __call__(self, ply, photographs, drawing, settings):
        self.model, self.photographs = load(ply), photographs
        torch.rand(7)
        torch.nn.Parameter(torch.zeros(1)).sum().backward()
        return replace(settings, dropout=0.25), torch.arange(len(self.model)) % 2 == 0


def test_stage_two_begins_with_what_a_look_between_the_stages_keeps(train, tmp_path, monkeypatch):
    look, out = Looked(), tmp_path / "out"
    dropped, learned_with = Stage2.dropped, set()

    def noted(stage, inputs):
        learned_with.add(stage.settings.dropout)
        return dropped(stage, inputs)

    monkeypatch.setattr(Stage2, "dropped", noted)
    summary = train(ply=True, look=look, settings=Settings(iterations=MORE, train="opacity"))
    assert look.photographs == summary.photographs
    first, last = (load(out / f"ply/point_cloud_{at - 1}.ply") for at in (TOTAL, TOTAL + MORE))
    assert torch.equal(look.model.xyz, first.xyz)
    assert evaluated(out, TOTAL)["num_GS"] == len(first)  # the script's own figures of stage 1
    kept = (len(first) + 1) // 2
    assert evaluated(out, TOTAL + MORE)["num_GS"] == len(last) == summary.gaussians == kept
    step = 1e-3  # the optimizer's last in stage 1, after the script had saved
    assert (last.xyz - first.xyz[::2]).abs().max() <= step
    assert summary.settings["dropout"] == sidecar.load(summary.model_after)[1].settings["dropout"]
    assert (summary.settings["dropout"], summary.steps) == (0.25, MORE)
    assert learned_with == {0.25}


def test_a_look_leaves_the_trainings_random_numbers_alone(train, tmp_path):
    class Only(Looked):
        def __call__(self, *given):
            super().__call__(*given)
            return given[-1], None

    looks, found = (None, Only()), []
    for number, look in enumerate(looks):
        train("--result_dir", tmp_path / str(number), ply=True, look=look)
        found.append(load(tmp_path / str(number) / f"ply/point_cloud_{TOTAL + MORE - 1}.ply"))
    assert torch.equal(found[0].xyz, found[1].xyz)
    if known := getattr(torch, "get_device_module", None):  # it remembers what it once answered
        assert known("cuda") is torch.cuda


def test_without_a_ply_there_is_no_look_and_that_is_said(train, caplog):
    look = Looked()
    assert train(look=look).steps == MORE
    assert not hasattr(look, "model")
    assert "without a look at the model: gsplat's simple_trainer: checkpoints alone" in caplog.text


def test_nor_where_it_draws_without_reading_a_photograph(train, caplog, monkeypatch):
    """What it draws then is made of all its Gaussians already."""
    never = replace(stepping.LOADER, attribute="_BaseDataLoaderIter.__len__")
    monkeypatch.setattr(stepping, "LOADER", never)
    assert train(ply=True, look=Looked()).steps == MORE
    assert "draws without reading a photograph" in caplog.text


def test_nor_where_the_script_changed_the_gaussians_since(train, caplog, monkeypatch):
    monkeypatch.setattr(starting, "same_means", lambda *_: False)
    assert train(ply=True, look=Looked()).steps == MORE
    assert "other Gaussians than those that train" in caplog.text


@pytest.mark.parametrize("sparse", [False, True])
def test_gaussians_move_in_stage_two_as_in_a_fine_tuning(sparse, train, tmp_path):
    """By the plugin of ``fragprune run``: its stage is another after the look.

    Sparse gradients have no rows of their own, so nothing moves there.
    """
    plugins, lively = installed(), Lively()

    class Moving(Looked):
        def __call__(self, *given):
            settings, kept = super().__call__(*given)
            lively.on, lively.rows = True, torch.arange(int(kept.sum()) // 4)
            return replace(settings, dropout=None), kept

    plugins.register(lively, "lively")
    try:
        settings = Settings(iterations=20, goal=Pressure(1e-3))
        more = ["--sparse_grad"] if sparse else []
        summary = train(*more, ply=True, look=Moving(), settings=settings)
    finally:
        plugins.remove("lively")
    assert lively.relocated == (0 if sparse else len(lively.rows))
    assert len(lively.rows) > 0
    assert summary.gaussians == len(load(summary.model_after))


@pytest.mark.parametrize(
    ("words", "factor"),
    [
        ([], None),
        (["--packed", "--antialiased"], "antialiasing"),
        (["--antialiased", "--no-antialiased"], None),
        (["--no_antialiased", "--antialiased"], "antialiasing"),
    ],
)
def test_its_models_are_measured_as_the_script_draws_them(words, factor):
    drawn = adapter.drawing(repo, ["default", *words])
    assert (drawn["near"], drawn.get("compensation")) == (0.01, factor)
    assert drawn["alpha_max"] == adapter.dialect(repo).alpha_max != 0.99  # of 1.4 and 1.5
    assert adapter.drawing(repo, ["default", "--near_plane", "0.3"])["near"] == 0.3
    with pytest.raises(NotComparedError, match="far plane"):
        adapter.drawing(repo, ["default", "--far-plane=9"])


def test_it_neither_resumes_nor_learns_on_several_gpus(train, monkeypatch):
    with pytest.raises(UsageError, match="from-iter"):
        train(stage="finetune")
    monkeypatch.setattr(torch.cuda, "device_count", lambda: 2)  # processes without thresholds
    with pytest.raises(EngineError, match="CUDA_VISIBLE_DEVICES"):
        train()


def test_another_script_with_gsplat_is_told_what_to_do(tmp_path):
    script = tmp_path / "mine.py"
    script.write_text("from gsplat import rasterization\n")
    assert Gsplat().trainer(HostRepo(script.parent), script) is None
    surfels = SCRIPT.read_text().replace("rasterization", "rasterization_2dgs")
    script.write_text(surfels)
    assert Gsplat().trainer(HostRepo(script.parent), script) is None
    with pytest.raises(UsageError, match="activate"):
        run([str(script)], RunOptions(device="cpu"))
