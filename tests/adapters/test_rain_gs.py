"""RAIN-GS: far splits, wide dilation, an own clock, on a miniature of the host."""

import sys
from importlib import import_module
from pathlib import Path

import pytest
import torch
from miniatures import runs
from miniatures.hosts import HOSTS
from miniatures.rain_gs import RainHost
from miniatures.runs import OPTIONS, check_stage_two, miniature, written
from miniatures.vanilla_3dgs import joint
from scenes import blended

from fragprune_plugins.adapting import HostRepo, read_ply
from fragprune_plugins.files import sidecar
from fragprune_plugins.injection.launch import RunOptions, run
from fragprune_plugins.testing.conformance import found_adapter
from fragprune_plugins.testing.invariants.case import FixedThresholds
from fragprune_plugins.workbench.commands.options import EngineOptions
from fragprune_plugins.workbench.run.work import measure_models, photographs_of
from fragprune_rain_gs import PACKAGE, RainGS

COUNT = 16


mini, of = miniature(RainHost, RainGS, driver=RainHost)


def test_dilation_reaches_the_engine(mini):
    notes = FixedThresholds()
    with joint(**of(mini, plugins=[notes])) as host, torch.no_grad():
        model, camera = host.model(COUNT), host.camera(20, 14)
        host.store(model).open(host.adapter.opacities(model))
        render, pipe = import_module("gaussian_renderer").render, host.driver.pipe()
        wide = render(camera, model, pipe, torch.zeros(3), low_pass=40.0)
        assert notes.inputs.dilation == 40.0
        usual = render(camera, model, pipe, torch.zeros(3))
        assert notes.inputs.dilation == pytest.approx(0.3)
    assert (wide["radii"] > usual["radii"]).any()


@pytest.mark.parametrize("name", ["rain-gs", "4dgaussians"])
def test_depth_is_the_sum_of_blended_depths_and_has_no_gradient(name, tmp_path):
    notes, driver = FixedThresholds(), HOSTS[name]
    told = {"path": written(driver, tmp_path), "adapter": found_adapter(name), "driver": driver()}
    with joint(**told, plugins=[notes], engine="reference") as host:
        model, camera = host.model(COUNT), host.camera(20, 14)
        host.store(model).open(host.adapter.opacities(model))
        package = host.render(camera, model)
        view, splats = notes.inputs.view, notes.inputs.splats
        depths = splats.means @ view.viewmatrix[:3, 2] + view.viewmatrix[3, 2]
        assert torch.equal(splats.means, model.get_xyz) == (name == "rain-gs")  # or moved
        expected = blended(view, splats, depths.detach())
    torch.testing.assert_close(package["depth"], expected, rtol=1e-4, atol=1e-4)
    assert package["depth"].any()
    assert not package["depth"].requires_grad
    assert package["render"].requires_grad


def command(mini, scene, out, iterations, *more):
    words = runs.command(mini / "train.py", scene, out, iterations, *more)
    return [word for word in words if word != "--eval"]


@pytest.fixture
def scene(photographs, tmp_path):
    """Not under the name of one of the host's scenes: it would take other pictures."""
    (tmp_path / "fox").symlink_to(photographs)
    return tmp_path / "fox"


@pytest.mark.parametrize("mode", ["ours", "ours_new", "paper_random"])
def test_every_mode_is_tuned_and_moves_opacities_and_thresholds_alone(mini, scene, tmp_path, mode):
    words = command(mini, scene, tmp_path / "out", 22, f"--{mode}", "--num_gaussians", 60)
    summary = run([*words, "--c2f"], OPTIONS)
    check_stage_two(summary, "rain-gs")
    assert summary.drawing == {}
    assert measure_models(photographs_of(summary), EngineOptions())[1]  # though without --eval
    assert {PACKAGE, "wandb"} & set(sys.modules) == set()


@pytest.mark.parametrize("mode", ["--ours", "--ours_new"])
def test_iterations_are_counted_where_the_host_sets_no_rate(mini, scene, tmp_path, mode):
    """In its newer mode the host announces iterations 12 to 24 as 0 to 12."""
    options = RunOptions(device="cpu", stage="joint", from_iter=15, settings=OPTIONS.settings)
    summary = run(command(mini, scene, tmp_path / "out", 24, mode), options)
    assert summary.model_after.parent.name == "iteration_24"
    assert summary.curves[0]["step"] == 16  # after iteration 15
    assert [c["step"] for c in summary.curves] == list(range(16, 24))
    store, _ = sidecar.load(summary.model_after)
    assert len(store) == len(read_ply(summary.model_after).xyz)


def test_what_resumes_is_left_without_the_modes():
    shared = ["-s", "a", "-m", "b", "--iterations", "9"]
    own = ["--ours_new", "--num_gaussians", "10", "--c2f", "--train_from=cluster"]
    assert RainGS().resumed_by(Path("train.py"), [*shared, *own]) == (Path("train.py"), shared)
    named = RainGS().resumed_by(Path("train.py"), ["-s", "a", "--exp_name", "e", "--ours"])[1]
    assert named == ["-s", "a", "--exp_name", "e", "-m", "output/e"]


@pytest.mark.parametrize(
    ("words", "images", "white"),
    [
        (["-s", "fox"], "images", False),
        (["-s", "data/room"], "images_2", False),
        (["--source_path=garden"], "images_4", False),
        (["-s", "garden/room", "-i", "mine"], "images_2", False),  # the host asks for rooms last
        (["-s", "fox", "--white_bg"], "images", True),
        (["-s", "fox", "-w"], "images", False),  # the host overwrites it
    ],
)
def test_photographs_are_read_from_where_the_host_reads_them(mini, words, images, white):
    read = RainGS().photographs(HostRepo(mini), words)
    assert (read.images, read.white_background) == (images, white)
