"""The real nerfstudio, on the CPU: ``pytest -m nerfstudio tests/studio``.

docs/how-to/nerfstudio.md says what to install.
"""

import json
import os
import re
import signal
import subprocess
import sys
import threading
from copy import deepcopy
from pathlib import Path

import numpy as np
import pytest
import torch
from PIL import Image
from plyfile import PlyData

import fragprune_plugins
from fragprune_nerfstudio import METHOD
from fragprune_nerfstudio.learning import Learning
from fragprune_plugins.errors import AlignmentError, SidecarError, UsageError
from fragprune_plugins.files import sidecar
from fragprune_plugins.injection.session import active_session
from fragprune_plugins.plugins.hookspecs import hookimpl
from fragprune_plugins.workbench.models import model as models

pytestmark = [pytest.mark.nerfstudio, pytest.mark.filterwarnings("ignore")]

TRAINING, STAGE2 = 40, 30
LOW = -6.0
"""An opacity that the exporter leaves out."""


@pytest.fixture(autouse=True)
def _alone():
    yield
    fragprune_plugins.deactivate()


@pytest.fixture(scope="module")
def methods():
    """nerfstudio's methods, imported as its commands import them."""
    from nerfstudio.configs.method_configs import (
        all_methods,
        method_configs,  # noqa: F401
    )

    return all_methods


def configured(methods, scene, out, **model):
    """A configuration of the method, as the command line makes it."""
    from nerfstudio.data.dataparsers.colmap_dataparser import ColmapDataParserConfig

    config = deepcopy(methods[METHOD])
    config.machine.device_type = "cpu"
    config.vis = "tensorboard"
    config.viewer.quit_on_train_completion = True
    config.output_dir, config.experiment_name, config.timestamp = Path(out), "room", "one"
    config.pipeline.datamanager.data = scene
    config.pipeline.datamanager.dataparser = ColmapDataParserConfig(
        colmap_path=Path("sparse/0"),
        orientation_method="none",
        center_method="none",
        auto_scale_poses=False,
        assume_colmap_world_coordinate_convention=False,
    )
    config.max_num_iterations = TRAINING + STAGE2
    config.steps_per_eval_image = config.steps_per_eval_all_images = 0
    given = {"num_downscales": 0, "warmup_length": 5, "refine_every": 10, "stop_screen_size_at": 0}
    given["fragprune"] = Learning(iterations=STAGE2, goal="pressure=3e-3")
    for name, value in (given | model).items():
        setattr(config.pipeline.model, name, value)
    return config


def trained(config):
    """A trainer after its training, as ns-train leaves it."""
    from nerfstudio.scripts.train import _set_random_seed

    config.save_config()
    _set_random_seed(config.machine.seed)
    trainer = config.setup(local_rank=0, world_size=1)
    trainer.setup()
    trainer.train()
    return trainer


def picture(pipeline):
    """A held-out view and its fragments, drawn as the viewer and the evaluation draw."""
    pipeline.eval()
    camera, _ = pipeline.datamanager.fixed_indices_eval_dataloader[0]
    return pipeline.model.get_outputs_for_camera(camera)["rgb"]


@pytest.fixture(scope="module")
def run(methods, scene, tmp_path_factory):
    """(config, checkpoint, held-out view, thresholds, number of Gaussians by iteration)."""
    config = configured(methods, scene, tmp_path_factory.mktemp("out"))
    from nerfstudio.models.splatfacto import SplatfactoModel

    counts, original = [], SplatfactoModel.step_cb

    def counting(self, optimizers, step):
        counts.append(self.num_points)
        return original(self, optimizers, step)

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(SplatfactoModel, "step_cb", counting)
        trainer = trained(config)
    store = active_session().store(trainer.pipeline.model)
    with torch.no_grad():
        view = picture(trainer.pipeline)
        with fragprune_plugins.paused():
            whole = picture(trainer.pipeline)
    fragprune_plugins.deactivate()
    (checkpoint,) = trainer.checkpoint_dir.glob("*.ckpt")
    return config, checkpoint, (view, whole), store.state_dict(), counts


def loaded(config):
    from nerfstudio.utils.eval_utils import eval_setup

    return eval_setup(config.get_base_dir() / "config.yml")[1]


def test_densification_ends_where_stage_two_begins(run):
    *_, counts = run
    assert len(set(counts[:TRAINING])) > 1  # it does densify
    assert set(counts[TRAINING:]) == {counts[-1]}


def test_thresholds_are_in_the_checkpoint_and_one_for_each_gaussian(run):
    _, checkpoint, _, store, _ = run
    saved = torch.load(checkpoint, map_location="cpu")["pipeline"]  # torch's safe loader
    tensors = saved["_model._extra_state"]["tensors"]
    assert torch.equal(tensors["logits"], store["logits"])
    assert len(tensors["logits"]) == len(saved["_model.gauss_params.means"])


def test_a_model_that_is_loaded_draws_the_same_to_the_bit_and_truncated(run):
    config, _, (view, whole), *_ = run
    pipeline = loaded(config)
    with torch.no_grad():
        assert torch.equal(picture(pipeline), view)
        with fragprune_plugins.paused():
            assert torch.equal(picture(pipeline), whole)
    assert not torch.equal(view, whole)


def test_the_viewers_thread_draws_with_thresholds_too(run):
    """Its pictures are drawn by ``get_outputs_for_camera`` in a thread of its own."""
    config, _, (view, _), *_ = run
    pipeline, drawn = loaded(config), []
    thread = threading.Thread(target=lambda: drawn.append(picture(pipeline)))
    thread.start()
    thread.join()
    assert torch.equal(drawn[0], view)


def test_the_crop_box_of_the_viewer_draws_with_the_thresholds_of_its_rows(run):
    from nerfstudio.data.scene_box import OrientedBox

    config, *_ = run
    pipeline = loaded(config)
    model = pipeline.model
    model.eval()
    camera, _ = pipeline.datamanager.fixed_indices_eval_dataloader[0]
    middle = model.means.detach().median(dim=0).values
    spread = 2 * model.means.detach().std(dim=0)
    box = OrientedBox.from_params(tuple(middle.tolist()), (0.0, 0.0, 0.0), tuple(spread.tolist()))
    inside = box.within(model.means).squeeze()
    assert 0 < int(inside.sum()) < len(inside)
    cropped = model.get_outputs_for_camera(camera, obb_box=box)["rgb"]
    with torch.no_grad():  # the same Gaussians alone, none of the others visible
        model.gauss_params["opacities"][~inside] = -20.0
    alone = model.get_outputs_for_camera(camera)["rgb"]
    torch.testing.assert_close(cropped, alone, atol=1e-6, rtol=0)
    with fragprune_plugins.paused():
        assert not torch.equal(model.get_outputs_for_camera(camera)["rgb"], alone)


@pytest.mark.parametrize("load", ["load_dir", "load_checkpoint"])
def test_a_training_that_is_resumed_keeps_its_thresholds(run, methods, scene, tmp_path, load):
    _, checkpoint, _, store, counts = run
    config = configured(methods, scene, tmp_path)
    setattr(config, load, checkpoint.parent if load == "load_dir" else checkpoint)
    config.max_num_iterations = 3
    trainer = trained(config)
    model, session = trainer.pipeline.model, active_session()
    assert trainer.step == TRAINING + STAGE2 + 2
    assert model.begin == TRAINING
    assert session.models[model].stage.steps == STAGE2 + 3
    learned = session.store(model).state_dict()
    moved = (learned["logits"] - store["logits"]).abs()
    assert 0 < float(moved.max()) < 1  # three steps, and not anew
    assert learned["steps"] == store["steps"] + 3
    assert model.num_points == counts[-1]
    before = torch.load(checkpoint, map_location="cpu")["pipeline"]
    assert not torch.equal(model.opacities.detach(), before["_model.gauss_params.opacities"])


def test_stage_two_can_begin_at_a_checkpoint_of_plain_splatfacto(run, methods, scene, tmp_path):
    _, checkpoint, *_ = run
    content = torch.load(checkpoint, map_location="cpu")
    del content["pipeline"]["_model._extra_state"]
    plain = tmp_path / "plain" / checkpoint.name
    plain.parent.mkdir()
    torch.save(content, plain)
    config = configured(methods, scene, tmp_path, fragprune=Learning(iterations=4))
    config.load_dir, config.max_num_iterations = plain.parent, 4
    trainer = trained(config)
    model = trainer.pipeline.model
    assert model.begin == TRAINING + STAGE2
    assert not active_session().store(model).neutral
    assert active_session().models[model].stage.steps == 4


def test_the_control_is_as_long_and_has_no_thresholds(methods, scene, tmp_path):
    settings = Learning(iterations=5, goal="control")
    config = configured(methods, scene, tmp_path, fragprune=settings)
    config.max_num_iterations = 12
    trainer = trained(config)
    session = active_session()
    assert session.models[trainer.pipeline.model].stage.steps == 5
    assert session.store(trainer.pipeline.model).neutral


@pytest.mark.parametrize("train", ["opacity", "appearance", "all"])
def test_what_does_not_learn_stays_as_it_is_to_the_bit(run, methods, scene, tmp_path, train):
    _, checkpoint, *_ = run
    settings = Learning(iterations=3, train=train)
    config = configured(methods, scene, tmp_path, fragprune=settings)
    config.load_dir, config.max_num_iterations = checkpoint.parent, 3
    after = trained(config).pipeline.model.gauss_params
    before = torch.load(checkpoint, map_location="cpu")["pipeline"]
    stays = {n: torch.equal(p, before[f"_model.gauss_params.{n}"]) for n, p in after.items()}
    learns = {
        "opacity": {"opacities"},
        "appearance": {"opacities", "features_dc", "features_rest"},
        "all": set(after),
    }[train]
    # harmonics above degree 0 train from iteration 1,000 on
    assert {name for name in after if not stays[name]} == learns - {"features_rest"}


@pytest.mark.parametrize(
    ("length", "model", "remedy"),
    [
        (STAGE2, {}, "--max-num-iterations"),
        (50, {"fragprune_from": 50}, "--max-num-iterations"),
        (50, {"fragprune": Learning(goal="faster=1.5")}, "pressure, fewer, portable"),
    ],
)
def test_a_training_that_learns_nothing_is_refused(methods, scene, tmp_path, length, model, remedy):
    config = configured(methods, scene, tmp_path, **model)
    config.max_num_iterations = length
    with pytest.raises(UsageError, match=re.escape(remedy)):
        trained(config)


# -- interrupting


class Signals:
    """Sends this process signals when a step of stage 2 is reported."""

    def __init__(self, number, step, times=1):
        self.number, self.step, self.times = number, step, times

    @hookimpl
    def fragprune_step(self, stats):
        if stats.step == self.step:
            for _ in range(self.times):
                signal.raise_signal(self.number)


@pytest.mark.parametrize(("number", "code"), [(signal.SIGINT, 130), (signal.SIGTERM, 143)])
def test_an_interrupted_stage_two_leaves_a_checkpoint_to_go_on_from(
    methods, scene, tmp_path, number, code, plug, ctrl_c, capsys
):
    before = {each: signal.getsignal(each) for each in (signal.SIGINT, signal.SIGTERM)}
    plug(Signals(number, 7))
    with pytest.raises(SystemExit) as caught:
        trained(configured(methods, scene, tmp_path / "one"))
    assert caught.value.code == code
    assert {each: signal.getsignal(each) for each in before} == before
    (checkpoint,) = (tmp_path / "one").rglob("*.ckpt")
    said = capsys.readouterr().out
    assert f"--load-checkpoint {checkpoint} " in said
    left = int(re.search(r"--max-num-iterations (\d+)", said)[1])
    done = torch.load(checkpoint, map_location="cpu")["step"] + 1
    assert done + left == TRAINING + STAGE2
    assert TRAINING < done < TRAINING + STAGE2
    fragprune_plugins.deactivate()

    config = configured(methods, scene, tmp_path / "two")
    config.load_checkpoint, config.max_num_iterations = checkpoint, left
    model = trained(config).pipeline.model
    assert model.begin == TRAINING
    assert active_session().models[model].stage.steps == STAGE2


def test_a_second_ctrl_c_waits_for_no_iteration_and_saves_no_half_of_one(
    methods, scene, tmp_path, plug, ctrl_c, capsys
):
    plug(Signals(signal.SIGINT, 7, times=2))
    with pytest.raises(SystemExit) as caught:
        trained(configured(methods, scene, tmp_path))
    assert caught.value.code == 130
    assert "nothing is saved" in capsys.readouterr().out
    assert not list(tmp_path.rglob("*.ckpt"))


def test_ctrl_c_before_stage_two_saves_it_too(methods, scene, tmp_path, monkeypatch, ctrl_c):
    from nerfstudio.models.splatfacto import SplatfactoModel

    original = SplatfactoModel.step_post_backward

    def interrupting(self, step):
        original(self, step)
        if step == 11:
            signal.raise_signal(signal.SIGINT)

    monkeypatch.setattr(SplatfactoModel, "step_post_backward", interrupting)
    config = configured(methods, scene, tmp_path)
    with pytest.raises(SystemExit) as caught:
        trained(config)
    assert caught.value.code == 130
    (checkpoint,) = tmp_path.rglob("*.ckpt")
    assert torch.load(checkpoint, map_location="cpu")["step"] == 11


def test_ctrl_c_after_it_closes_the_viewer_as_ever(methods, scene, tmp_path, monkeypatch, ctrl_c):
    from nerfstudio.engine.trainer import Trainer

    config = configured(methods, scene, tmp_path)
    config.viewer.quit_on_train_completion = False

    def interrupting(self):
        signal.raise_signal(signal.SIGINT)

    monkeypatch.setattr(Trainer, "_train_complete_viewer", interrupting)
    with pytest.raises(KeyboardInterrupt):
        trained(config)


# -- exporting


def export(config, folder, **options):
    from nerfstudio.scripts.exporter import ExportGaussianSplat

    base = config.get_base_dir() / "config.yml"
    ExportGaussianSplat(load_config=base, output_dir=folder, **options).main()
    return folder / "splat.ply"


def altered(run, tmp_path, change):
    """The run's folder with another checkpoint, and its configuration."""
    config, checkpoint, *_ = run
    content = torch.load(checkpoint, map_location="cpu")
    change(content["pipeline"])
    config = deepcopy(config)
    config.output_dir = tmp_path / "altered"
    config.save_config()
    folder = config.get_checkpoint_dir()
    folder.mkdir()
    torch.save(content, folder / checkpoint.name)
    return config


def test_an_exported_ply_has_its_thresholds_beside_it(run, tmp_path):
    config, _, _, store, _ = run
    ply = export(config, tmp_path)
    model = models.load(ply)
    assert len(model) == len(store["logits"])
    assert torch.equal(sidecar.load(ply)[0].logits.detach(), store["logits"])
    assert model.thresholds is not None


def test_a_model_without_thresholds_is_exported_without(run, tmp_path):
    def plain(state):
        del state["_model._extra_state"]

    assert not sidecar.find(export(altered(run, tmp_path, plain), tmp_path))


def test_thresholds_follow_the_exporters_filter(run, tmp_path):
    """It leaves out rows with NaN and of low opacity; and rows with equal positions are there."""
    *_, store, _ = run

    def faint(state):
        state["_model.gauss_params.opacities"][[0, 7, 8]] = LOW
        state["_model.gauss_params.scales"][3, 1] = torch.nan
        state["_model.gauss_params.means"][5] = state["_model.gauss_params.means"][6]

    ply = export(altered(run, tmp_path, faint), tmp_path)
    kept = [row for row in range(len(store["logits"])) if row not in (0, 3, 7, 8)]
    assert PlyData.read(str(ply))["vertex"].count == len(kept)
    assert torch.equal(sidecar.load(ply)[0].logits.detach(), store["logits"][kept])


def test_a_box_exports_the_thresholds_of_what_is_in_it(run, tmp_path):
    config, _, _, store, _ = run
    box = {"obb_rotation": (0.0, 0.0, 0.3), "obb_scale": (3.0, 3.0, 3.0)}
    ply = export(config, tmp_path, obb_center=(0.0, 0.0, 0.0), **box)
    x = torch.tensor(PlyData.read(str(ply))["vertex"]["x"])
    assert 0 < len(x) < len(store["logits"])
    whole = export(config, tmp_path / "whole")
    every = torch.tensor(PlyData.read(str(whole))["vertex"]["x"])
    rows = (every[:, None] == x).any(dim=1).nonzero()[:, 0]
    assert torch.equal(sidecar.load(ply)[0].logits.detach(), store["logits"][rows])


def shorter(tensors):
    for name in ("logits", "exp_avg", "exp_avg_sq"):
        tensors[name] = tensors[name][1:]


def broken(tensors):
    tensors["logits"][0] = torch.nan


@pytest.mark.parametrize(
    ("spoil", "error", "said"),
    [(shorter, AlignmentError, "saved thresholds"), (broken, SidecarError, None)],
)
def test_a_checkpoint_with_thresholds_of_other_rows_or_none_is_refused(
    run, tmp_path, spoil, error, said
):
    def change(state):
        spoil(state["_model._extra_state"]["tensors"])

    with pytest.raises(error, match=said):
        export(altered(run, tmp_path, change), tmp_path)


# -- its commands, each in its own process


def command(*words, fails=False):
    """What a command printed."""
    words = [str(Path(sys.executable).with_name(words[0])), *map(str, words[1:])]
    environment = {**os.environ, "PYTHONWARNINGS": "ignore", "COLUMNS": "200"}
    done = subprocess.run(words, capture_output=True, text=True, env=environment, timeout=600)
    assert (done.returncode != 0) == fails, done.stdout[-3000:] + done.stderr[-3000:]
    return done.stdout + done.stderr


@pytest.mark.timeout(1800)
def test_from_a_command_for_splatfacto_to_a_model_that_fragprune_reads(scene, tmp_path):
    none = ["--orientation-method", "none", "--center-method", "none", "--auto-scale-poses"]
    data = ["colmap", "--data", scene, "--colmap-path", "sparse/0", *none, "False"]
    model = ["--pipeline.model.num-downscales", 0, "--max-num-iterations", 20]
    said = command(
        *("fragprune", "run", "--device", "cpu", "--iters", 10, "--pressure", "3e-3", "--"),
        *("ns-train", "splatfacto", "--output-dir", tmp_path, "--vis", "tensorboard"),
        *("--viewer.quit-on-train-completion", "True", *model, *data),
    )
    assert "10 iterations of stage 2" in said
    assert "fewer fragments" in said
    (config,) = tmp_path.glob("*/fragprune-splatfacto/*/config.yml")
    command("ns-export", "gaussian-splat", "--load-config", config, "--output-dir", tmp_path)
    into = ["--output-path", tmp_path / "eval.json", "--render-output-path", tmp_path / "eval"]
    command("ns-eval", "--load-config", config, *into)
    psnr = json.loads((tmp_path / "eval.json").read_text())["results"]["psnr"]
    assert 5 < psnr < 50
    how = ["--split", "test", "--rendered-output-names", "rgb", "--image-format", "png"]
    command("ns-render", "dataset", "--load-config", config, "--output-path", tmp_path, *how)
    drawn = [np.asarray(Image.open(file)) for file in sorted((tmp_path / "test").rglob("*.png"))]
    seen = [np.asarray(Image.open(file)) for file in sorted((tmp_path / "eval").glob("*.png"))]
    assert len(drawn) == len(seen) > 0
    for ours, both in zip(drawn, seen, strict=True):  # ns-eval's: the photograph, and the picture
        assert np.array_equal(ours, both[:, -ours.shape[1] :])
    assert "with cutoffs" in command(
        "fragprune", "profile", tmp_path / "splat.ply", "--data", scene
    )
    script = ["-m", "nerfstudio.scripts.exporter", "gaussian-splat", "--load-config", config]
    other = tmp_path / "other"
    refused = command("python", *script, "--output-dir", other, fails=True)
    assert "Run: ns-export gaussian-splat" in refused
    assert not list(other.glob("*.ply"))


KILLED = """
import signal, sys
from fragprune_plugins.workbench.commands import cli
from fragprune_plugins.injection import stepping

report = stepping.report

def interrupting(session, state, stats):
    report(session, state, stats)
    if stats.step == 4:
        signal.raise_signal(signal.SIGINT)

stepping.report = interrupting
signal.signal(signal.SIGINT, signal.default_int_handler)
cli(sys.argv[1:])
"""


@pytest.mark.timeout(600)
def test_an_interrupted_run_ends_with_130_and_names_the_checkpoint(scene, tmp_path):
    words = ["run", "--device", "cpu", "--iters", 10, "--", "ns-train", "splatfacto"]
    words += ["--output-dir", tmp_path, "--vis", "tensorboard", "--max-num-iterations", 20]
    words += ["--pipeline.model.num-downscales", 0, "colmap", "--data", scene]
    words += ["--colmap-path", "sparse/0"]
    done = subprocess.run(
        [sys.executable, "-c", KILLED, *map(str, words)], capture_output=True, text=True
    )
    assert done.returncode == 130, done.stderr[-3000:]
    (checkpoint,) = tmp_path.rglob("*.ckpt")
    assert f"--load-checkpoint {checkpoint}" in done.stderr
