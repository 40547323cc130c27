"""2D Gaussian Splatting: surfels and their maps, on a miniature of the host."""

from dataclasses import replace

import pytest
import torch
from cli.commands import run_json
from miniatures.runs import OPTIONS, check_measured, command, miniature
from miniatures.surfels import SurfelHost
from miniatures.vanilla_3dgs import joint

from fragprune_2dgs import SurfelSplatting
from fragprune_plugins import Portable, Settings
from fragprune_plugins.engines.reference import ReferenceEngine
from fragprune_plugins.errors import InputError, UsageError
from fragprune_plugins.hosts.source import HostRepo
from fragprune_plugins.injection import process
from fragprune_plugins.injection.launch import RunOptions, run
from fragprune_plugins.testing.invariants.case import FixedThresholds
from fragprune_plugins.workbench.figures import records
from fragprune_plugins.workbench.run.work import photographs_of

COUNT = 16


mini, of = miniature(SurfelHost, SurfelSplatting, driver=SurfelHost)


def test_the_hosts_maps_are_those_of_the_oracle_in_its_order(mini):
    notes = FixedThresholds()
    with joint(**of(mini, plugins=[notes])) as host:
        model, camera = host.model(COUNT), host.camera(20, 14)
        host.step(model, camera, 1)
        host.store(model).open(host.adapter.opacities(model))
        drawn = host.render(camera, model)
        truth = ReferenceEngine().rasterize(notes.inputs, host.store(model).values)
    assert notes.inputs.splats.scales.shape == (COUNT, 2)
    turn = camera.world_view_transform[:3, :3].T
    depth = (truth.surface[:1] / truth.alpha).nan_to_num(0, 0)
    expected = {
        "render": truth.image,
        "rend_alpha": truth.alpha,
        "rend_normal": (truth.surface[1:4].permute(1, 2, 0) @ turn).permute(2, 0, 1),
        "surf_depth": 0.6 * depth + 0.4 * truth.surface[4:5],
        "rend_dist": truth.surface[5:],
    }
    for name, tensor in expected.items():
        torch.testing.assert_close(drawn[name], tensor, rtol=1e-4, atol=1e-5)
    assert (drawn["rend_normal"].norm(dim=0) > 0.1).any()
    assert drawn["rend_dist"].max() > 0


@pytest.mark.parametrize("maps", ["6:7", "7:10"])
def test_a_drawing_that_reads_maps_beyond_these_is_refused(tmp_path, maps):
    drawing = f"def render(pc):\n    image, radii, allmap = rasterizer()\n    f(allmap[{maps}])\n"
    (tmp_path / "gaussian_renderer.py").write_text(drawing)
    found = str(SurfelSplatting().fingerprint(HostRepo(tmp_path)))
    assert ("reads allmap[7:10]" in found) == (maps == "7:10")


def test_matrices_in_place_of_scales_are_refused(mini):
    with joint(**of(mini)) as host:
        model, camera = host.model(COUNT), host.camera()
        pipe = host.driver.pipe()
        pipe.compute_cov3D_python = True
        model.get_covariance = lambda modifier: torch.zeros(COUNT, 9)
        host.driver.pipe = lambda: pipe
        with pytest.raises(InputError, match="cov3D_precomp"):
            host.render(camera, model)


def test_a_gpu_is_refused_before_the_training(mini, photographs, tmp_path, monkeypatch):
    monkeypatch.setattr(process, "host_device", lambda wanted, engine: "cuda")
    words = command(mini / "train.py", photographs, tmp_path / "out", 20)
    with pytest.raises(UsageError, match=r"2D Gaussian Splatting.*cuda engine.*--device cpu"):
        run(words, RunOptions(device="cuda"))
    assert not (tmp_path / "out").exists()


@pytest.fixture(scope="module")
def trained(mini, photographs, tmp_path_factory):
    out = tmp_path_factory.mktemp("trained")
    words = command(mini / "train.py", photographs, out, 20)
    return run(words, OPTIONS), words, out


def read(path):
    return SurfelSplatting().read_model(path)


def test_we_measure_the_picture_that_the_hosts_own_script_renders(mini, trained, photographs):
    summary, _, out = trained
    run([str(mini / "render.py"), "-m", str(out), "--skip_train"], OPTIONS)
    (picture,) = (out / "test" / "ours_29" / "renders").glob("*.png")
    check_measured(summary, picture, photographs, read)


@pytest.mark.parametrize("first", [0, 1], ids=["stage 2", "joint"])
def test_compare_draws_its_models_by_a_record_of_the_host(trained, first):
    """Where thresholds learned within a training, the record names no model of before."""
    summary, _, _ = trained
    read = photographs_of(summary)
    said = replace(read, models=read.models[first:]).as_dict()
    records.leave(summary.model_after, "run", {"photographs": said})
    found = run_json("compare", summary.model_before, summary.model_after)
    assert found["b"]["fragments_per_pixel"] < found["a"]["fragments_per_pixel"]


def test_portable_is_refused_before_the_training(mini, photographs, tmp_path):
    words = command(mini / "train.py", photographs, tmp_path / "out", 20)
    options = RunOptions(device="cpu", settings=Settings(iterations=8, goal=Portable()))
    with pytest.raises(InputError, match="surfels"):
        run(words, options)
    assert not any(tmp_path.glob("out/chkpnt*"))
