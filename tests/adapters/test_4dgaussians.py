"""4DGaussians: two phases, a network beside the PLY and Python configurations, on a miniature."""

import os
import runpy
import shutil
import sys
from dataclasses import replace
from pathlib import Path
from types import ModuleType, SimpleNamespace

import pytest
import torch
from miniatures import runs
from miniatures.moving import MovingHost
from miniatures.runs import FINETUNE, OFF, OPTIONS

from fragprune_4dgaussians import MovingGaussians, PythonFile
from fragprune_plugins.errors import HostFailed, ModelFileError, UsageError
from fragprune_plugins.files import sidecar
from fragprune_plugins.injection.launch import run
from fragprune_plugins.learning.schedule import Settings
from fragprune_plugins.testing.host import joint, running
from fragprune_plugins.workbench.models import model as models

LAST = 20
EVERYTHING = replace(OPTIONS, settings=Settings(iterations=8, threshold_lr=0.3))


mini, of = runs.miniature(MovingHost, MovingGaussians, driver=MovingHost)


@pytest.fixture(scope="module")
def trained(mini, photographs, tmp_path_factory):
    """An output folder after the host's own training."""
    out = tmp_path_factory.mktemp("trained") / "out"
    words = command(mini, photographs, out, "--checkpoint_iterations", 6, LAST)
    run(words, OFF)
    return out


@pytest.fixture
def output(trained, tmp_path):
    """A copy of it, with the times of its files."""
    return Path(shutil.copytree(trained, tmp_path / "out"))


def command(mini, photographs, out, *more, iterations=LAST):
    return runs.command(mini / "train.py", photographs, out, iterations, *more)


def load(path):
    return torch.load(path, weights_only=False)


def network(ply):
    return load(ply.with_name("deformation.pth"))


def same(one, other):
    return all(torch.equal(one[name], other[name]) for name in one)


@pytest.mark.parametrize("options", [OPTIONS, EVERYTHING], ids=["opacity", "all"])
def test_stage_2_goes_on_from_the_fine_phase_alone(mini, photographs, tmp_path, options):
    words = command(mini, photographs, tmp_path / "out")
    summary = run(words, options)
    before, after = summary.model_before, summary.model_after
    assert (before.parent.name, after.parent.name) == ("iteration_20", "iteration_29")
    assert summary.steps == 8
    assert summary.fragments_after < summary.fragments_before
    frozen = options is OPTIONS
    assert (runs.frozen_differences(before, after) == []) == frozen
    assert same(network(before), network(after)) == frozen
    store, info = sidecar.load(after)
    assert (len(store), store.steps) == (summary.gaussians, 8)
    assert info.adapter == "4dgaussians"
    assert summary.photographs is None
    assert "network" in summary.not_compared.found
    assert not list((tmp_path / "out").glob("chkpnt_coarse*"))


def test_one_run_learns_after_an_iteration_of_the_fine_phase_alone(mini, photographs, tmp_path):
    """The coarse phase reaches that iteration first, and must train on as if nothing were."""
    more = ("--coarse_iterations", 14, "--checkpoint_iterations", 9, 14, 16, LAST)
    summary = run(
        command(mini, photographs, tmp_path / "out", *more), replace(FINETUNE, from_iter=9)
    )
    assert summary.steps == LAST - 9 - 1
    assert "network" in summary.not_compared.found  # whatever else is missing
    files = ("coarse_9", "coarse_14", "fine_9", "fine_16", f"fine_{LAST}")
    nine, fourteen, fine, early, late = (
        load(tmp_path / "out" / f"chkpnt_{name}.pth")[0] for name in files
    )
    assert nine[1].shape != fourteen[1].shape or not torch.equal(nine[1], fourteen[1])
    assert not any("fragprune" in each[12] for each in (nine, fourteen, fine))
    assert torch.equal(early[1], late[1])
    assert not torch.equal(early[8], late[8])
    assert late[12]["fragprune"]["steps"] == LAST - 9 - 1


def test_a_stage_2_that_would_freeze_the_coarse_phase_is_refused(mini, photographs, tmp_path):
    words = command(mini, photographs, tmp_path / "out")
    with pytest.raises(UsageError, match="an earlier phase") as caught:
        run(words, replace(EVERYTHING, stage="finetune", from_iter=0))
    assert "--from-iter" in caught.value.remedy
    assert not list((tmp_path / "out").rglob("point_cloud.ply"))


def test_a_newer_checkpoint_of_the_first_phase_is_no_start(mini, photographs, output):
    coarse = output / "chkpnt_coarse_6.pth"
    os.utime(coarse)
    summary = run(command(mini, photographs, output), FINETUNE)
    assert summary.model_after.parent.name == f"iteration_{LAST + 9}"


@pytest.mark.parametrize("stage", ["auto", "finetune", "joint"])
def test_checkpoints_of_the_first_phase_begin_no_stage_2(mini, photographs, output, stage):
    words = command(mini, photographs, output, "--start_checkpoint", output / "chkpnt_coarse_6.pth")
    if stage == "auto":  # the training is ended first
        assert run(words, OPTIONS).model_before.parent.name == f"iteration_{LAST}"
        return
    with pytest.raises(UsageError, match="phase coarse") as caught:
        run(words, replace(OPTIONS, stage=stage, from_iter=3 if stage == "joint" else None))
    assert "--stage off" in caught.value.remedy


def test_a_folder_that_is_named_as_a_phase_is_refused_before_training(mini, photographs, tmp_path):
    out = tmp_path / "coarse-to-fine"
    with pytest.raises(UsageError, match="coarse-to-fine"):
        run(command(mini, photographs, out), OPTIONS)
    assert not out.exists()


def test_stage_2_starts_from_a_ply_and_the_network_beside_it(mini, photographs, output):
    for checkpoint in output.glob("*.pth"):
        checkpoint.unlink()
    summary = run(command(mini, photographs, output), FINETUNE)
    before, after = summary.model_before, summary.model_after
    assert runs.frozen_differences(before, after) == []
    assert same(network(before), network(after))
    assert summary.fragments_after < summary.fragments_before
    assert not list(output.rglob(".fragprune*"))


def test_a_ply_without_its_network_is_no_start(mini, photographs, output):
    for file in [*output.glob("*.pth"), *output.rglob("deformation.pth")]:
        file.unlink()
    with pytest.raises(ModelFileError, match=r"deformation\.pth"):
        run(command(mini, photographs, output), FINETUNE)


def test_the_folder_that_expname_means_is_found(mini, photographs, trained, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    shutil.copytree(trained, tmp_path / "output" / "a" / "b")
    words = command(mini, photographs, "x", "--expname", "a/b")
    place = words.index("-m")
    summary = run(words[:place] + words[place + 2 :], FINETUNE)
    assert summary.model_after.resolve().is_relative_to(tmp_path / "output" / "a" / "b")


def test_a_host_that_starts_itself_again_fails(mini, photographs, tmp_path):
    words = command(mini, photographs, tmp_path / "out", "--nan_at", 3)
    with pytest.raises(HostFailed, match="start itself again"):
        run(words, OFF)


class Config(dict):
    """What mmcv 1 makes of a file of plain dicts."""

    @classmethod
    def fromfile(cls, path):
        values = {k: v for k, v in runpy.run_path(path).items() if not k.startswith("__")}
        bases = values.pop("_base_", [])
        found = cls()
        for base in [bases] if isinstance(bases, str) else bases:
            found = cls(_merged(found, cls.fromfile(str(Path(path).parent / base))))
        return cls(_merged(found, values))


def _merged(one, other):
    both = [key for key in other if isinstance(one.get(key), dict)]
    return {**one, **other, **{key: _merged(one[key], other[key]) for key in both}}


@pytest.fixture(params=["as mmcv reads", "mmcv"])
def mmcv(request, monkeypatch):
    if request.param == "mmcv":
        module = pytest.importorskip("mmcv")
        if not hasattr(module, "Config"):
            pytest.skip("mmcv 2 reads no configurations; the host needs mmcv 1")
        return
    module = ModuleType("mmcv")
    module.Config = Config
    monkeypatch.setitem(sys.modules, "mmcv", module)


@pytest.fixture
def config(tmp_path):
    (tmp_path / "base.py").write_text(
        "ModelHiddenParams = dict(net_width=4, resolution_t=3)\n"
        f"OptimizationParams = dict(iterations={LAST}, coarse_iterations=3)\n"
    )
    file = tmp_path / "scene.py"
    file.write_text(
        "_base_ = './base.py'\nModelHiddenParams = dict(resolution_t=4)\n"
        "PipelineParams = dict(debug=False)\n"
    )
    return file


def test_a_copy_in_another_folder_says_the_same_and_the_new_values(mmcv, config, tmp_path):
    file = PythonFile("--configs")
    known = {"net_width": 4, "resolution_t": 4, "iterations": LAST, "coarse_iterations": 3}
    known["debug"] = False
    assert file.read(config) == known
    values = {"iterations": 7, "start_checkpoint": "a b/c'd.pth", "checkpoint_iterations": [3, 7]}
    copy = tmp_path / "elsewhere" / "copy.py"
    copy.parent.mkdir()
    copy.write_text(file.copied(config, values))
    assert file.read(copy) == known | values
    again = tmp_path / "elsewhere" / "again.py"
    again.write_text(file.copied(copy, {"iterations": 9}))
    assert file.read(again) == known | values | {"iterations": 9}


def test_the_file_wins_and_stage_2_ends_where_it_should(mmcv, mini, photographs, config, tmp_path):
    text = config.read_text()
    words = command(mini, photographs, tmp_path / "out", "--configs", config, iterations=1000)
    summary = run(words, OPTIONS)
    assert summary.steps == 8
    assert summary.model_after.parent.name == f"iteration_{LAST + 9}"
    assert load(tmp_path / "out" / f"chkpnt_fine_{LAST}.pth")[1] == LAST
    assert network(summary.model_after)["grid_planes"].shape == (4, 4)
    assert config.read_text() == text
    arguments = (tmp_path / "out" / "cfg_args").read_text()  # what the host's render.py reads
    assert f"configs={str(config)!r}" in arguments


@pytest.mark.filterwarnings("ignore::pytest.PytestUnraisableExceptionWarning")  # mmcv's own
@pytest.mark.parametrize("text", [None, "x = (", "OptimizationParams = 3", "raise SystemError"])
def test_a_file_that_cannot_be_read_is_refused(mmcv, mini, photographs, tmp_path, text):
    file = tmp_path / "broken.py"
    if text is not None:
        file.write_text(text)
    with pytest.raises(UsageError, match="--configs"):
        run(command(mini, photographs, tmp_path / "out", "--configs", file), OPTIONS)


def test_the_file_is_read_without_the_hosts_mmcv(mini, photographs, config, tmp_path, monkeypatch):
    monkeypatch.setitem(sys.modules, "mmcv", None)
    assert PythonFile("--configs").read(config)["iterations"] == LAST
    with pytest.raises(HostFailed, match="mmcv"):
        run(command(mini, photographs, tmp_path / "out", "--configs", config), OPTIONS)


@pytest.mark.parametrize("read", ["truncated", "plain"])
def test_no_command_of_ours_draws_the_ply_as_if_it_were_the_model(output, read):
    ply = output / "point_cloud" / f"iteration_{LAST}" / "point_cloud.ply"
    with pytest.raises(ModelFileError, match="network beside them") as caught:
        models.load(ply, truncation=read == "truncated")
    assert "render.py" in caught.value.remedy


def test_ctrl_c_leaves_a_ply_and_its_network(mini, tmp_path):
    with joint(**of(mini, output=tmp_path)) as host:
        model, camera = host.model(16), host.camera()
        for iteration in (1, 2):
            host.step(model, camera, iteration)
        ply = host.save_learned()
        assert sidecar.find(ply)
        assert same(network(ply), model._deformation.state_dict())


def test_rates_that_the_host_sets_in_every_iteration_stay_its_own(mini):
    rates = {}
    with running(Settings(iterations=20), **of(mini)) as host:
        model, camera = host.model(16), host.camera()

        def note(optimizer, *_):
            rates.update({group["name"]: group["lr"] for group in optimizer.param_groups})

        host.step(model, camera, 1)
        model.optimizer.register_step_pre_hook(note)
        host.step(model, camera, 9_000)
        for name, schedule in model.schedules.items():
            assert rates[name] == schedule(9_000)
        assert rates["opacity"] < host.arguments.opacity_lr


def test_a_camera_that_is_a_dict_draws_the_same_picture(mini):
    """PanopticSports: its settings are ready, with matrices of one more dimension."""
    from importlib import import_module

    with joint(**of(mini)) as host:
        model, camera = host.model(16), host.camera()
        host.step(model, camera, 1)
        own = {}
        draw = import_module("gaussian_renderer").render
        kind = import_module("diff_gaussian_rasterization").GaussianRasterizer

        def keep(self, raster_settings, original=kind.__init__):
            original(self, raster_settings)
            own["settings"] = raster_settings

        kind.__init__ = keep
        with torch.no_grad():
            picture = host.render(camera, model)["render"]
            settings = own["settings"]._replace(
                viewmatrix=camera.world_view_transform[None],
                projmatrix=camera.full_proj_transform[None],
            )
            given = {"camera": settings, "time": camera.time}
            pipe, black = host.driver.pipe(), torch.zeros(3)
            ready = draw(given, model, pipe, black, cam_type="PanopticSports")["render"]
        assert torch.equal(picture, ready)
        copied = {"camera": settings._replace(viewmatrix=settings.viewmatrix.clone()), "time": 0.3}
        assert host.adapter.view(given) == host.adapter.view(copied)
        assert host.adapter.view(given) != host.adapter.view(given | {"time": 0.4})
        assert host.adapter.view(SimpleNamespace(uid=5)) == 5
