"""Speedy-Splat, LP-3DGS and Compact-3DGS: what runs, and what is refused by name."""

from dataclasses import replace
from importlib import import_module
from pathlib import Path

import numpy as np
import pytest
import torch
from miniatures import runs
from miniatures.compact_3dgs import CompactHost
from miniatures.lp_3dgs import LPHost
from miniatures.runs import FINETUNE, OFF, OPTIONS, check_stage_two, edit, miniature, written
from miniatures.speedy_splat import SpeedyHost
from miniatures.vanilla_3dgs import joint, running
from plyfile import PlyData

from fragprune_compact_3dgs import Compact3DGS
from fragprune_lp_3dgs import LP3DGS
from fragprune_plugins.adapting import HostRepo, SeamCall, read_ply
from fragprune_plugins.errors import EngineError, HostFailed, UsageError
from fragprune_plugins.files import sidecar
from fragprune_plugins.injection.launch import run
from fragprune_speedy_splat import SpeedySplat

speedy, _ = miniature(SpeedyHost, SpeedySplat)
lp, _ = miniature(LPHost, LP3DGS)
compact, _ = miniature(CompactHost, Compact3DGS)


def command(root, *more):
    return runs.command(root / "train.py", *more)


def test_speedys_third_output_is_a_time_that_can_be_divided_by(speedy):
    with joint(path=speedy, adapter=SpeedySplat()) as host:
        times = host.render(host.camera(), host.model(20))["kernel_times"]
    assert times.shape == (1,)
    assert times[-1].item() > 0


def test_speedys_pruning_is_refused_and_never_gets_zeros(speedy, photographs, tmp_path):
    """Zeros for scores would prune every Gaussian."""
    with pytest.raises(EngineError, match="--prune_until_iter 0"):
        run(command(speedy, photographs, tmp_path, 12, "--prune_interval", 9), OFF)


def test_stage_two_of_speedy_prunes_nothing(speedy, photographs, tmp_path):
    more = ["--prune_interval", 14, "--checkpoint_iterations", 12]  # due in stage 2, at 14
    summary = run(command(speedy, photographs, tmp_path, 12, *more), OPTIONS)
    check_stage_two(summary, "speedy-splat")


def test_lp_prunes_by_the_weights_of_what_is_drawn(lp, photographs, tmp_path):
    """bw_score at iteration 12: 70 % stay; in stage 2, which passes it again, all do."""
    words = command(lp, photographs, tmp_path, 10, "--prune_method", "mini_splatting")
    with pytest.raises(HostFailed, match="ours_30000"):
        run([*words, "--iterations", "14"], OFF)
    (pruned,) = tmp_path.glob("point_cloud/iteration_14/point_cloud.ply")
    again = tmp_path / "again"
    words[words.index("-m") + 1] = str(again)
    with pytest.raises(HostFailed, match="ours_30000"):
        run([*words, "--iterations", "11", "--checkpoint_iterations", "11"], OFF)
    summary = run(words, FINETUNE)
    check_stage_two(summary, "lp-3dgs")
    rows = len(read_ply(summary.model_before).xyz)
    assert len(read_ply(pruned).xyz) == rows - int(0.3 * (rows - 1)) - 1


def test_lps_weights_add_up_to_the_picture_of_white_gaussians(lp):
    with joint(path=lp, adapter=LP3DGS()) as host, torch.no_grad():
        render = import_module("gaussian_renderer").render
        given = host.camera(), host.model(20), host.driver.pipe(), torch.zeros(3)
        package = render(*given, override_color=torch.ones(20, 3), bw_score=True)
        plain = render(*given)
    torch.testing.assert_close(package["important_score"].sum(), package["render"][0].sum())
    assert package["gaussians_count"] is None
    assert plain["important_score"] is None


def test_scores_that_no_engine_computes_are_refused(lp, photographs, tmp_path):
    words = command(lp, photographs, tmp_path, 14, "--prune_method", "rad_splat")
    with pytest.raises(EngineError, match="mw_score"):
        run(words, OFF)


def test_the_model_with_a_mask_is_refused_before_stage_one(lp, photographs, tmp_path):
    with pytest.raises(UsageError, match="compact_3dgs"):
        run(command(lp, photographs, tmp_path, 9, "--prune_method", "compact_3dgs"), OPTIONS)
    assert not list(tmp_path.glob("point_cloud/*"))


def test_compact_is_known_by_its_codebooks_and_hash_grid(tmp_path):
    edit(written(CompactHost, tmp_path) / "scene/gaussian_model.py", "recolor", "colours")
    findings = Compact3DGS().match(HostRepo(tmp_path)).findings
    assert "no recolor" in str(findings[0])


def test_compact_learns_in_the_later_part_of_its_run(compact, photographs, tmp_path):
    options = replace(FINETUNE, from_iter=10)
    summary = run(command(compact, photographs, tmp_path, 16), options)
    store, info = sidecar.load(summary.model_after)
    assert (info.adapter, summary.steps) == ("compact-3dgs", 5)
    assert len(store) == info.rows == len(PlyData.read(summary.model_after)["vertex"].data)
    assert not store.neutral
    assert summary.fragments_after < summary.fragments_before


def test_compacts_thresholds_follow_gaussians_through_the_last_sort(compact, photographs, tmp_path):
    """The same training, stored in two orders: --comp sorts by place before it saves."""
    options = replace(OPTIONS, stage="joint", from_iter=3)
    stored = []
    for form in ("point_cloud.npz", "point_cloud_pp.npz"):
        out = tmp_path / form
        more = ["--store_npz", *(["--comp"] if "pp" in form else [])]
        run(command(compact, photographs, out, 16, *more), options)
        file = out / "point_cloud" / "iteration_16" / form
        stored.append((np.load(file)["arr_0"].tolist(), sidecar.load(file)[0].logits.tolist()))
    (plain, logits), (ordered, followed) = stored
    assert plain != ordered
    assert len({tuple(place) for place in plain}) == len(plain)
    assert [logits[plain.index(place)] for place in ordered] == followed


def test_compact_is_not_resumed():
    with pytest.raises(UsageError, match="--from-iter N"):
        Compact3DGS().resumed_by(Path("train.py"), [])


@pytest.mark.parametrize(
    ("there", "method", "file"),
    [
        (["point_cloud.ply"], "load_model", "point_cloud.ply"),
        (["point_cloud.ply", "point_cloud.npz"], "load_model", "point_cloud.npz"),
        (["point_cloud.npz", "point_cloud_pp.npz"], "load_model", "point_cloud_pp.npz"),
        ([], "save_npz", "point_cloud.npz"),
        ([], "save_npz_pp", "point_cloud_pp.npz"),
    ],
)
def test_compacts_files_are_found_as_the_host_finds_them(tmp_path, there, method, file):
    for name in there:
        (tmp_path / name).touch()
    (seam,) = (s for s in Compact3DGS.seams if s.attribute == f"GaussianModel.{method}")
    call = SeamCall(seam, lambda path: None, None, (str(tmp_path / "point_cloud"),), {})
    assert call.how() == tmp_path / file


@pytest.mark.parametrize("used", [True, False])
def test_compacts_codebooks_stop_where_they_are_in_use(compact, used):
    """They learn in the forward pass, by a backward pass of their own."""
    start = {"driver": CompactHost(), "from_step": 2 if used else 1}
    with running(path=compact, adapter=Compact3DGS(), **start) as host:
        model, camera = host.model(20), host.camera()
        for iteration in (1, 2):
            host.step(model, camera, iteration)  # the second is the first to use them
        books = [layer._codebook for layer in (*model.vq_scale.layers, *model.vq_rot.layers)]
        before = [book.embed.detach().clone() for book in books]
        for iteration in (3, 4):
            host.step(model, camera, iteration)
        after = [book.embed.detach() for book in books]
    stopped = [torch.equal(*pair) for pair in zip(before, after, strict=True)]
    assert all(stopped) if used else not any(stopped)
