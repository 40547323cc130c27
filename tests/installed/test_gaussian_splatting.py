"""The real packages gaussian-splatting and gaussian-splatting-mcmc, on the CPU."""

import json
import random
import shutil
from pathlib import Path
from types import SimpleNamespace

import pytest
import torch

from fragprune_gaussian_splatting import GaussianSplatting
from fragprune_graphdeco import photographs as reading_of_photographs
from fragprune_plugins.adapting import (
    HostRepo,
    NotComparedError,
    Photographs,
    SessionError,
    read_ply,
)
from fragprune_plugins.files import sidecar
from fragprune_plugins.hosts.choosing import attempt
from fragprune_plugins.injection.launch import RunOptions, run
from fragprune_plugins.learning.schedule import Settings
from fragprune_plugins.plugins.loading import load_plugins
from fragprune_plugins.workbench.check.work import judge
from fragprune_vanilla_3dgs import Vanilla3DGS

PARAMETERS = ("xyz", "f_dc", "f_rest", "opacity", "scaling", "rotation")
OPTIONS = {
    **{"densify_from_iter": 4, "densify_interval": 4, "densify_until_iter": 20},
    **{"densify_grad_threshold": 1e-5, "densify_target_lower_bound": 0},
    **{"prune_from_iter": 6, "prune_interval": 6, "prune_until_iter": 20},
}


def test_only_the_installed_package_fits(tmp_path):
    adapter, repo = GaussianSplatting(), HostRepo.installed("gaussian_splatting")
    match = adapter.match(repo)
    assert match.fits, match.findings
    assert "2.11.0" in match.findings[0].found
    assert not Vanilla3DGS().match(repo).fits
    assert not adapter.match(HostRepo(tmp_path)).fits
    assert not adapter.match(HostRepo(repo.root / "gaussian_splatting")).fits


def test_its_checkout_is_told_to_be_installed(tmp_path):
    package = HostRepo.installed("gaussian_splatting").root / "gaussian_splatting"
    shutil.copytree(package, tmp_path / "gaussian_splatting", ignore=lambda *_: ["__pycache__"])
    plugins, repo = load_plugins(), HostRepo(tmp_path)
    verdict = judge(repo, attempt(repo, plugins.adapters), plugins.adapters, plugins)
    assert verdict.kind == "never"
    assert f"pip install {tmp_path}; fragprune check gaussian_splatting" in verdict.sentence


def test_another_backend_is_refused_by_name():
    model = type("GsplatGaussianModel", (), {"__module__": "gaussian_splatting.models.gsplat"})()
    with pytest.raises(SessionError, match="--backend"):
        GaussianSplatting().model_of(SimpleNamespace(instance=None, arguments={"model": model}))


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


def test_photographs_are_read_as_they_are_unless_it_changes_cameras_or_masks_them(tmp_path):
    adapter, repo = GaussianSplatting(), HostRepo.installed("gaussian_splatting")
    words = ["-s", str(tmp_path), "-d", "out"]
    whole = Photographs(tmp_path, centred=True, opaque=True, held_out=False)
    assert adapter.photographs(repo, [*words, "--mode", "densify"]) == whole
    for more in ("--mode", "camera-densify"), ("--load_camera", "cameras.json"):
        with pytest.raises(NotComparedError, match="cameras that it trains"):
            adapter.photographs(repo, [*words, *more])
    (tmp_path / "image_masks").mkdir()
    with pytest.raises(NotComparedError, match="under the masks"):
        adapter.photographs(repo, words)
    assert adapter.photographs(repo, [*words, "--no_image_mask"]) == whole


@pytest.mark.parametrize("mode", ["densify", "camera"])
def test_its_own_command_trains_and_is_fine_tuned(mode, photographs, tmp_path):
    out = tmp_path / "out"
    words = ["python", "-m", "gaussian_splatting.train", "-s", photographs, "-d", out, "-i", 12]
    words += ["--mode", mode, "--sh_degree", 1, "--no_image_mask", "--no_depth_data"]
    options = OPTIONS if mode == "densify" else {"camera_position_lr_init": 0.01}
    for name, value in options.items():
        words += ["-o", f"{name}={value}"]
    settings = Settings(iterations=12, threshold_lr=0.3, train="opacity")
    torch.manual_seed(0)  # its own script sets no seed, and so few steps end by chance
    random.seed(0)
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


@pytest.mark.parametrize(("stage", "begins"), [("joint", 1), ("finetune", None)])
def test_a_run_may_begin_from_a_ply(stage, begins, photographs, tmp_path):
    words = ["python", "-m", "gaussian_splatting.train", "-s", photographs, "--sh_degree", 1]
    words += ["--no_image_mask", "--no_depth_data"]
    command = [str(word) for word in words]
    run([*command, "-d", str(tmp_path / "first"), "-i", "3"], RunOptions(stage="off", device="cpu"))
    (model,) = tmp_path.glob("first/point_cloud/iteration_3/*.ply")
    settings = Settings(iterations=6, train="opacity")
    options = RunOptions(stage=stage, device="cpu", settings=settings, from_iter=begins)
    out = tmp_path / "second"
    summary = run([*command, "-d", str(out), "-l", str(model), "-i", "6"], options)
    assert summary.model_after.is_relative_to(out if stage == "joint" else out / "finetuned")
    assert len(sidecar.load(summary.model_after)[0]) == summary.gaussians
    assert model.exists()


def test_a_script_of_ones_own_runs_with_the_package_answered(tmp_path):
    package = "gaussian_splatting.diff_gaussian_rasterization"
    answered = "assert 'Stand-in' in GaussianRasterizer.__doc__\n"
    (tmp_path / "mine.py").write_text(f"from {package} import GaussianRasterizer\n{answered}")
    summary = run(["python", str(tmp_path / "mine.py")], RunOptions(device="cpu"))
    assert (summary.adapter, summary.steps) == ("gaussian-splatting", 0)


def test_an_installed_host_is_not_read_with_all_that_is_installed_beside_it(monkeypatch):
    """Its imports lead to torch: 12 GB of syntax trees."""
    monkeypatch.setattr(reading_of_photographs, "unlike", None)
    adapter = GaussianSplatting()
    repo = HostRepo.installed(adapter.installed[0])
    assert adapter.not_drawn(repo, []) == []
    read = HostRepo.tree

    def tree(repo, module):
        assert not module.startswith("torch"), module
        return read(repo, module)

    monkeypatch.setattr(HostRepo, "tree", tree)
    adapter.fingerprint(repo)
