"""Mip-Splatting: two filters, absolute gradients, on a miniature of the host."""

import sys

import pytest
import torch
from miniatures.mip_splatting import MipHost
from miniatures.runs import OPTIONS, check_measured, command, miniature
from miniatures.vanilla_3dgs import joint, label, running

from fragprune_mip_splatting import MipSplatting
from fragprune_plugins.adapting import HostRepo, NotComparedError
from fragprune_plugins.files import sidecar
from fragprune_plugins.injection.launch import run
from fragprune_plugins.testing.invariants.case import FixedThresholds

COUNT = 16


mini, of = miniature(MipHost, MipSplatting, driver=MipHost)


def test_filters_and_offsets_reach_the_engine(mini):
    notes = FixedThresholds()
    with joint(**of(mini, plugins=[notes])) as host:
        model, camera = host.model(COUNT), host.camera(20, 14)
        host.step(model, camera, 1)
        jitter = torch.rand(14, 20, 2) - 0.5
        drawn = host.driver.render(camera, model, torch.zeros(3), subpixel_offset=jitter)
    assert notes.inputs.dilation == pytest.approx(0.1)
    assert notes.inputs.compensation == "mip"
    assert torch.equal(notes.inputs.sample_offsets, jitter)
    splats = notes.inputs.splats
    assert torch.equal(splats.opacities, model.get_opacity_with_3D_filter[:, 0])
    assert torch.equal(splats.scales, model.get_scaling_with_3D_filter)
    assert drawn["render"].requires_grad


@pytest.mark.parametrize("opened", [False, True], ids=["host alone", "with thresholds"])
def test_the_third_gradient_is_the_sum_over_pixels_of_both_others(mini, opened):
    """Without it every Gaussian is densified: pixel by pixel, backward once for each."""
    with joint(**of(mini)) as host:
        model, camera = host.model(COUNT), host.camera(9, 7)
        if opened:
            host.store(model).open(host.adapter.opacities(model))
        weights = torch.rand(3, 7, 9, generator=torch.Generator().manual_seed(0)) - 0.5
        package = host.render(camera, model)
        (package["render"] * weights).sum().backward(retain_graph=True)
        whole = package["viewspace_points"].grad.clone()
        total = torch.zeros(COUNT)
        for y in range(7):
            for x in range(9):
                package["viewspace_points"].grad = None
                (package["render"] * weights)[:, y, x].sum().backward(retain_graph=True)
                total += package["viewspace_points"].grad[:, :2].abs().sum(dim=1)
    assert (total > 0).sum() > COUNT / 2
    torch.testing.assert_close(whole[:, 2], total, rtol=1e-4, atol=1e-7)


def test_a_gradient_that_equals_the_quantile_counts_as_the_host_counts_it(mini):
    """The quantile often is one of the gradients; the norm of one number may be rounded."""
    with joint(**of(mini)) as host:
        for seed in range(20):
            model = host.model(COUNT, seed=seed)
            label(host, model)
            absolute = torch.rand(COUNT, 1, generator=torch.Generator().manual_seed(seed)) * 1e-3
            quantile = absolute.sort(dim=0).values[COUNT // 2]
            none = torch.zeros(COUNT, 1)
            model.densify_and_clone(none, 1.0, absolute, quantile, 1e9)
            expected = int((torch.norm(absolute, dim=-1) >= quantile).sum())
            assert len(host.store(model)) == COUNT + expected


@pytest.fixture(scope="module")
def trained(mini, photographs, tmp_path_factory):
    """Trained with jittered rays and another kernel, then fine-tuned."""
    out = tmp_path_factory.mktemp("trained")
    words = command(mini / "train.py", photographs, out, 20, "-k", "0.2", "--ray_jitter")
    return run(words, OPTIONS), words, out


def test_we_measure_the_picture_that_the_hosts_own_script_renders(mini, trained, photographs):
    summary, _, out = trained
    assert summary.drawing == {"dilation": 0.2, "compensation": "mip"}
    run([str(mini / "render.py"), "-m", str(out), "--skip_train"], OPTIONS)
    picture = out / "test" / "ours_29" / "test_preds_1" / "00000.png"
    check_measured(summary, picture, photographs, MipSplatting().read_model)


@pytest.mark.parametrize(("flag", "kernel"), [((), 0.1), (("--kernel_size=0.3",), 0.3)])
def test_the_size_of_the_2d_filter_is_read_from_the_command_or_the_source(mini, flag, kernel):
    drawing = MipSplatting().drawing(HostRepo(mini), ["--eval", *flag])
    assert drawing == {"dilation": kernel, "compensation": "mip"}
    with pytest.raises(NotComparedError, match="--load_allres"):
        MipSplatting().drawing(HostRepo(mini), ["--eval", "--load_allres"])


def test_the_hosts_fusing_script_carries_thresholds_along(mini, trained, tmp_path):
    summary, _, out = trained
    fused = tmp_path / "fused.ply"
    run([str(mini / "create_fused_ply.py"), "-m", str(out), "--output_ply", str(fused)], OPTIONS)
    ours, theirs = sidecar.load(fused)[0], sidecar.load(summary.model_after)[0]
    assert torch.equal(ours.logits, theirs.logits)


def test_an_installed_open3d_is_left_alone(mini, monkeypatch):
    theirs = type(sys)("open3d")
    monkeypatch.setitem(sys.modules, "open3d", theirs)
    with running(**of(mini)):
        assert sys.modules["open3d"] is theirs
    assert sys.modules["open3d"] is theirs
