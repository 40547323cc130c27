"""The kernels' own sources, emulated on the CPU, against the oracle in float64.

The rules and tolerances of native/test_against_oracle.py apply. Emulated arithmetic is a GPU's to
the last bit but for exp2 and 1/x, where a GPU takes its special unit (2 and 1 units in the last
place); threads run in another order each time a seed says so.
"""

from dataclasses import replace

import pytest
import scenes
import torch
from gpu.emulated import double_by_default
from native import test_against_oracle as native
from native.test_against_oracle import (
    check_gradients,
    draw_pair,
    expect_oracle,
    projected,
    test_changes_in_place_are_noticed,
    test_nothing_to_draw_leaves_the_background,
    test_tall_stacks_stop_where_the_oracle_does,
)
from native.test_dialects import test_offsets_beyond_all_bounds_are_refused
from native.test_invariants import (
    assert_identical,
    everything,
    test_where_torch_puts_new_tensors_by_default_is_nothing_to_it,
)

from fragprune_plugins.engines.cpu.engine import CpuEngine
from fragprune_plugins.engines.cuda import engine as cuda
from fragprune_plugins.engines.cuda import frame
from fragprune_plugins.engines.cuda.engine import CudaEngine
from fragprune_plugins.errors import EngineError, InputError

# those of the cpu engine, over this one
__all__ = [
    "test_changes_in_place_are_noticed",
    "test_nothing_to_draw_leaves_the_background",
    "test_offsets_beyond_all_bounds_are_refused",
    "test_tall_stacks_stop_where_the_oracle_does",
    "test_where_torch_puts_new_tensors_by_default_is_nothing_to_it",
]

KINDS = [
    *("plain", "sh 3, antialiasing", "cov3d", "odd size, sh 2", "colours, modifier", "mip", "near"),
    *("capped gradient", "absolute gradient", "features, colours, offsets", "stopped", "scores"),
]
"""Of the cpu engine's dialects those that reach other kernels or macros."""


@pytest.mark.parametrize(("kind", "truncated"), [("plain", False), *((k, True) for k in KINDS)])
def test_images_and_gradients_equal_the_oracle(engine, kind, truncated):
    inputs = scenes.random_scene(1, **native.KINDS[kind])
    expect_oracle(engine, inputs, scenes.random_thresholds(1, 60) if truncated else None)


@pytest.mark.parametrize("kind", ["absolute gradient", "features, colours, offsets"])
def test_footprints_equal_the_oracle(engine, kind):
    inputs = projected(scenes.random_scene(5, **native.KINDS[kind]))
    expect_oracle(engine, inputs, scenes.random_thresholds(5, 60))


def test_a_soft_rim_is_refused(engine):
    with pytest.raises(InputError, match=r"soft rim.*--device cpu"):
        engine.rasterize(scenes.random_scene(0, 4, rim="soft"), torch.full((4,), 0.5))


def test_surfels_are_refused(engine):
    with pytest.raises(EngineError, match=r"surfels.*--device cpu"):
        engine.rasterize(scenes.random_scene(5, 20, flat=True), None)


def test_kernels_write_single_precision_whatever_torchs_default_is(device):
    inputs, thresholds = scenes.random_scene(0, features=3), scenes.random_thresholds(0, 60)
    engine = CudaEngine(device, deterministic=True)
    expected = everything(engine, inputs, thresholds)
    with double_by_default():
        assert_identical(expected, everything(engine, inputs, thresholds))


def test_tiles_of_footprints_may_be_any_integers(engine):
    inputs = projected(scenes.random_scene(5))
    wide = replace(inputs, splats=replace(inputs.splats, tiles=inputs.splats.tiles.long()))
    drawn = [everything(engine, each, None)["image"] for each in (inputs, wide)]
    assert torch.equal(*drawn)


def test_what_fine_tuning_freezes_costs_no_kernel_and_changes_no_gradient(engine, device):
    inputs, thresholds = scenes.random_scene(0), scenes.random_thresholds(0, 60)
    made, leaves = scenes.leaves(inputs)
    tau = thresholds.clone().requires_grad_()
    engine.rasterize(made, tau).image.square().sum().backward()
    opacities = inputs.splats.opacities.clone().requires_grad_()
    frozen = replace(inputs, splats=replace(inputs.splats, opacities=opacities))
    few = thresholds.clone().requires_grad_()
    engine.rasterize(frozen, few).image.square().sum().backward()
    assert device.launched[-1][1]["FP_GEOMETRY"] == device.launched[-1][1]["FP_COLOUR"] == 0
    for whole, part in ((tau.grad, few.grad), (leaves["opacities"].grad, opacities.grad)):
        assert (whole - part).abs().max() < 1e-5 * whole.abs().max()


def test_deterministic_runs_agree_to_the_bit_whatever_the_order(device):
    engine = CudaEngine(device, deterministic=True)
    inputs = scenes.random_scene(3, 150, 50, 37, features=3, colors=True)
    thresholds = torch.full((150,), 0.05)
    found = []
    for device.seed in (1, 2, 3):
        found.append(everything(engine, inputs, thresholds))
    for other in found[1:]:
        assert_identical(found[0], other)
    _, _, same = draw_pair(engine, inputs, thresholds)
    check_gradients(engine, inputs, thresholds, same)


def test_images_counts_and_scores_do_not_depend_on_the_order(engine, device):
    inputs = scenes.random_scene(4, 300, 70, 50, scores=True, counts=True)
    found = []
    for device.seed in (1, 2):
        found.append(engine.rasterize(inputs, None))
    for name in ("image", "winners", "weights_per_gaussian", "fragments_per_gaussian"):
        assert torch.equal(getattr(found[0], name), getattr(found[1], name)), name
    assert found[0].evaluated_per_pixel == found[1].evaluated_per_pixel
    assert found[0].entries_per_pixel == found[1].entries_per_pixel


@pytest.mark.parametrize(
    ("n", "width", "height", "size"),
    [(9000, 70, 50, 0.15), (150, 330, 290, 6.0)],
    ids=["several blocks sort", "more tiles than one pass of sorting tells apart; giants"],
)
def test_larger_scenes_equal_the_cpu_engine(engine, n, width, height, size):
    inputs = scenes.random_scene(3, n, width, height, scale_modifier=size, counts=True)
    thresholds = scenes.random_thresholds(3, n)
    with torch.no_grad():
        expected = CpuEngine().rasterize(inputs, thresholds)
        found = engine.rasterize(inputs, thresholds)
    assert torch.equal(expected.radii, found.radii)
    same = expected.fragments == found.fragments
    assert (~same).sum() <= 1 + same.numel() // 500
    assert (expected.image - found.image)[:, same].abs().max() < 4e-5


def test_room_that_another_thread_makes_meanwhile_is_not_this_frames(device, monkeypatch):
    inputs, small, read = scenes.random_scene(0), CudaEngine(device), frame.Drawing.read
    expected = small.rasterize(inputs, None).image
    small.capacity = 7

    def meanwhile(drawing: frame.Drawing) -> int:
        small.capacity = 1 << 13
        return read(drawing)

    monkeypatch.setattr(frame.Drawing, "read", meanwhile)
    assert torch.equal(small.rasterize(inputs, None).image, expected)


def test_room_is_not_made_for_more_entries_than_can_be_counted(device, monkeypatch):
    inputs, small = scenes.random_scene(0), CudaEngine(device)
    most = 1 + round(small.rasterize(inputs, None).entries_per_pixel * 40 * 28)
    monkeypatch.setattr(cuda, "ENTRIES_MAX", most)
    small.capacity = 7
    small.rasterize(inputs, None)
    assert small.capacity == most


def test_more_entries_than_can_be_counted_are_refused(engine, monkeypatch):
    monkeypatch.setattr(frame, "ENTRIES_MAX", 10)
    with pytest.raises(EngineError, match="entries"):
        engine.rasterize(scenes.random_scene(0), None)


def test_tensors_elsewhere_are_refused(engine, device, monkeypatch):
    monkeypatch.setattr(device, "kind", "cuda")
    with pytest.raises(InputError, match="Gaussians on cpu"):
        engine.rasterize(scenes.random_scene(0), None)


@pytest.mark.parametrize("rows", [0, 10, 61])
def test_thresholds_of_another_model_are_refused(engine, device, rows):
    before = len(device.launched)
    with pytest.raises(InputError, match=rf"thresholds: shape \({rows},\)"):
        engine.rasterize(scenes.random_scene(0), torch.full((rows,), 0.1))
    assert len(device.launched) == before


def test_a_poisoned_pixel_reaches_those_alone_that_draw_there(engine):
    inputs = scenes.random_scene(6, 200, 50, 37, features=3)

    def rows(at_pixel: float, elsewhere: float, found) -> torch.Tensor:
        """Of Gaussians with such a gradient, when the picture's gradients are these."""
        made, leaves = scenes.leaves(inputs)
        leaves["thresholds"] = tau = scenes.random_thresholds(6, 200).requires_grad_()
        out = engine.rasterize(made, tau)
        upstream = torch.full((3, 37, 50), elsewhere)
        upstream[:, 20, 30] = at_pixel
        torch.autograd.backward([out.image, out.features], [upstream, upstream])
        grads = (leaf.grad.reshape(200, -1) for k, leaf in leaves.items() if k != "background")
        return found(torch.cat(list(grads), dim=1)).any(1)

    assert 0 < (draw_there := rows(1.0, 0.0, lambda grads: grads != 0)).sum() < 50
    assert torch.equal(rows(torch.nan, 0.3, lambda grads: ~grads.isfinite()), draw_there)
