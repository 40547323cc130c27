"""The real packages gaussian-splatting and gaussian-splatting-mcmc, on the CPU."""

from __future__ import annotations

import json
from functools import partial
from importlib.util import find_spec
from pathlib import Path

import pytest
import torch

from fragprune_gaussian_splatting import GaussianSplatting
from fragprune_plugins.errors import SessionError
from fragprune_plugins.hosts.source import HostRepo
from fragprune_plugins.injection.launch import RunOptions, run
from fragprune_plugins.learning.schedule import Settings
from fragprune_plugins.storage import sidecar
from fragprune_plugins.storage.ply import read_ply
from fragprune_vanilla_3dgs import Vanilla3DGS

PARAMETERS = ("xyz", "f_dc", "f_rest", "opacity", "scaling", "rotation")
OPTIONS = {
    "densify_from_iter": 4,
    "densify_interval": 4,
    "densify_until_iter": 20,
    "densify_grad_threshold": 1e-5,
    "densify_target_lower_bound": 0,
    "prune_from_iter": 6,
    "prune_interval": 6,
    "prune_until_iter": 20,
}
RELOCATION = {
    "relocate_from_iter": 3,
    "relocate_interval": 3,
    "relocate_until_iter": 20,
    "cap_max": 190,
    "noise_lr": 5e5,
}
TRAINERS = ["densify", "mcmc"] if find_spec("gaussian_splatting_mcmc") else ["densify"]


def trained(kind: str, photographs: Path, **options):
    """(trainer, model, cameras) of the installed package, made as its own scripts make them."""
    from gaussian_splatting import GaussianModel
    from gaussian_splatting.dataset.colmap import ColmapCameraDataset, colmap_init
    from gaussian_splatting.trainer import BaseOpacityResetDensificationTrainer, NoopDensifier

    dataset = ColmapCameraDataset(str(photographs), load_mask=False, load_depth=False).to("cuda")
    model = colmap_init(GaussianModel(1).to("cuda"), str(photographs))
    if kind == "mcmc":
        from gaussian_splatting_mcmc.trainer import MCMCTrainerWrapper

        make = partial(MCMCTrainerWrapper, NoopDensifier)
        return make(model, dataset, **{**RELOCATION, **options}), model, dataset
    return (
        BaseOpacityResetDensificationTrainer(model, dataset, **{**OPTIONS, **options}),
        model,
        dataset,
    )


def test_only_the_installed_package_fits_and_every_seam_is_found(tmp_path):
    adapter, repo = GaussianSplatting(), HostRepo.installed("gaussian_splatting")
    match = adapter.match(repo)
    assert match.fits, match.findings
    assert "2.11.0" in match.findings[0].found
    assert not Vanilla3DGS().match(repo).fits
    assert not adapter.match(HostRepo(tmp_path)).fits
    assert not adapter.match(HostRepo(repo.root / "gaussian_splatting")).fits


@pytest.mark.parametrize("kind", TRAINERS)
def test_rows_keep_their_thresholds_through_every_change(kind, photographs, unmoved):
    with unmoved(GaussianSplatting()) as session:
        torch.manual_seed(0)
        trainer, model, cameras = trained(kind, photographs, feature_lr=0.0)
        rows = len(model.get_xyz)
        names = torch.arange(rows, dtype=torch.float32)
        with torch.no_grad():
            model._features_dc[:, 0, 0] = names  # copied by every operation, moved by none
            if kind == "mcmc":
                model._opacity[::3] = -6.0  # dead: to be relocated
        store = session.store(model)
        store.logits = (-20 + names / 100).requires_grad_(True)
        store._set_moments(names + 1, names + 1, torch.tensor(1.0))
        before, changes = names, 0
        for step in range(24):
            trainer.step(cameras[step % len(cameras)])
            now = model._features_dc.detach()[:, 0, 0]
            changes += not torch.equal(now, before)
            before = now
            assert len(store) == len(model.get_xyz)
            torch.testing.assert_close(store.logits.detach(), -20 + now / 100, rtol=0, atol=0)
            moments = store.optimizer.state[store.logits]["exp_avg"]
            assert torch.all((moments == now + 1) | (moments == 0))
            assert len(moments[moments > 0].unique()) == (moments > 0).sum()  # nobody's twice
        assert changes >= 4
        assert len(model.get_xyz) != rows


@pytest.mark.parametrize("kind", TRAINERS)
def test_stage_2_moves_opacities_and_thresholds_alone(kind, photographs, session_on):
    with session_on(
        GaussianSplatting(), settings=Settings(iterations=8, threshold_lr=0.3)
    ) as session:
        options = {"opacity_reset_from_iter": 1, "opacity_reset_interval": 1}
        trainer, model, cameras = trained(
            kind, photographs, **(options if kind == "densify" else {})
        )
        before = {
            name: getattr(model, f"_{name}").detach().clone()
            for name in ("xyz", "features_dc", "features_rest", "scaling", "rotation", "opacity")
        }
        neutral = session.store(model).logits.detach().clone()
        for step in range(8):
            trainer.step(cameras[step % len(cameras)])
        moved = {n for n, old in before.items() if not torch.equal(getattr(model, f"_{n}"), old)}
        assert moved == {"opacity"}
        assert (model.get_opacity > 0.02).any()  # no reset, and the optimizer's step was made
        assert not torch.equal(session.store(model).logits.detach(), neutral)
        session.expect_drawn()


def test_steps_that_draw_nothing_with_thresholds_are_an_error(photographs, session_on):
    with session_on(GaussianSplatting()) as session:
        trainer, _, cameras = trained("densify", photographs)
        session.expect_drawn()  # nothing has begun
        trainer.update_learning_rate()
        with pytest.raises(SessionError, match="no view"):
            session.expect_drawn()
        trainer.step(cameras[0])
        session.expect_drawn()


def test_every_original_is_back_when_the_session_ends(photographs, session_on):
    with session_on(GaussianSplatting()) as session:
        trained("densify", photographs)
        from gaussian_splatting import GaussianModel
        from gaussian_splatting.trainer import BaseTrainer

        assert hasattr(GaussianModel.save_ply, "__wrapped__")
        originals = [GaussianModel.save_ply.__wrapped__, BaseTrainer.__init__.__wrapped__]
        assert session.deactivate() == []
        assert [GaussianModel.save_ply, BaseTrainer.__init__] == originals


def test_another_backend_is_refused_by_name():
    model = type("GsplatGaussianModel", (), {"__module__": "gaussian_splatting.models.gsplat"})()
    with pytest.raises(SessionError, match="--backend"):
        GaussianSplatting().model_of(object(), {"model": model})


@pytest.mark.parametrize(
    ("words", "added"),
    [
        (["--mode", "densify", "-d", "out"], []),
        (["--mode", "camera", "-d", "out"], ["--load_camera", str(Path("out") / "cameras.json")]),
        (["--mode", "camera", "-d", "out", "--load_camera", "c.json"], []),
    ],
)
def test_stage_2_goes_on_with_the_cameras_that_stage_1_trained(words, added):
    script, arguments = GaussianSplatting().resumed_by(Path("train.py"), words)
    assert (script, arguments) == (Path("train.py"), words + added)


@pytest.mark.parametrize("mode", ["densify", "camera"])
def test_its_own_command_trains_and_is_fine_tuned(mode, photographs, tmp_path):
    out = tmp_path / "out"
    words = ["python", "-m", "gaussian_splatting.train", "-s", photographs, "-d", out, "-i", 12]
    words += ["--mode", mode, "--sh_degree", 1, "--no_image_mask", "--no_depth_data"]
    options = OPTIONS if mode == "densify" else {"camera_position_lr_init": 0.01}
    for name, value in options.items():
        words += ["-o", f"{name}={value}"]
    settings = Settings(iterations=12, threshold_lr=0.3)
    summary = run([str(word) for word in words], RunOptions(device="cpu", settings=settings))
    assert summary.adapter == "gaussian-splatting"
    assert summary.model_before == out / "point_cloud/iteration_12/point_cloud.ply"
    assert summary.model_after == out / "finetuned/point_cloud/iteration_12/point_cloud.ply"
    before, after = read_ply(summary.model_before), read_ply(summary.model_after)
    moved = [n for n in PARAMETERS if not torch.equal(getattr(before, n), getattr(after, n))]
    assert moved == ["opacity"]
    assert len(sidecar.load(summary.model_after)[0]) == len(after.xyz)
    assert summary.fragments_after < summary.fragments_before
    if mode == "camera":
        files = [folder / "cameras.json" for folder in (out, out / "finetuned")]
        first, second = ([c["position"] for c in json.loads(f.read_text())] for f in files)
        assert first == [pytest.approx(position, abs=1e-5) for position in second]  # rate: 1e-2


@pytest.mark.parametrize("stage", ["joint", "finetune"])
def test_a_run_may_begin_from_a_ply(stage, photographs, tmp_path):
    words = ["python", "-m", "gaussian_splatting.train", "-s", photographs, "--sh_degree", 1]
    words += ["--no_image_mask", "--no_depth_data"]
    command = [str(word) for word in words]
    run([*command, "-d", str(tmp_path / "first"), "-i", "3"], RunOptions(stage="off", device="cpu"))
    (model,) = tmp_path.glob("first/point_cloud/iteration_3/*.ply")
    options = RunOptions(stage=stage, device="cpu", settings=Settings(iterations=6))
    out = tmp_path / "second"
    summary = run([*command, "-d", str(out), "-l", str(model), "-i", "6"], options)
    assert summary.model_after.is_relative_to(out if stage == "joint" else out / "finetuned")
    assert len(sidecar.load(summary.model_after)[0]) == summary.gaussians
    assert model.exists()


def test_a_script_of_ones_own_runs_with_the_package_answered(tmp_path):
    script = tmp_path / "mine.py"
    script.write_text(
        "from gaussian_splatting.diff_gaussian_rasterization import GaussianRasterizer\n"
        "assert 'Stand-in' in GaussianRasterizer.__doc__\n"
    )
    summary = run(["python", str(script)], RunOptions(device="cpu"))
    assert (summary.adapter, summary.iterations) == ("gaussian-splatting", 0)
