"""What the cpu engine promises to the bit: threads, runs, neutral thresholds, monotone cuts."""

from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from itertools import product
from typing import get_args

import pytest
import scenes
import torch
from torch import inf, nan

from fragprune_plugins.constants import NEUTRAL_LOGIT
from fragprune_plugins.engines.cpu.engine import CpuEngine
from fragprune_plugins.types import Rim

# Enough Gaussians and tiles for several pieces of work per thread, in sorting and binning too.
LARGE = {"n": 20_000, "width": 150, "height": 100, "scale_modifier": 0.3}


def everything(engine, inputs, thresholds):
    """All outputs and all gradients of one loss."""
    made, leaves = scenes.leaves(replace(inputs, counts=True, scores=True))
    if thresholds is not None:
        leaves["thresholds"] = thresholds = thresholds.detach().clone().requires_grad_()
    out = engine.rasterize(made, thresholds)
    loss = out.image.square().sum() + out.invdepth.sum() + out.alpha.sum()
    more = {name: getattr(out, name) for name in ("features", "surface")}
    more = {name: plane for name, plane in more.items() if plane is not None}
    loss = loss + sum(plane.square().sum() for plane in more.values())
    (loss + out.fragments_per_pixel).backward()
    kept = {name: getattr(out, name).detach() for name in ("image", "invdepth", "alpha", "radii")}
    scores = ("weights_per_gaussian", "wins_per_gaussian", "winners")
    counts = ("fragments", "fragments_per_gaussian")
    kept |= {name: getattr(out, name) for name in counts + scores}
    kept |= {name: plane.detach() for name, plane in more.items()}
    return kept | {f"grad {name}": leaf.grad for name, leaf in leaves.items()}


def assert_identical(first: dict[str, torch.Tensor], second: dict[str, torch.Tensor]) -> None:
    for name, tensor in first.items():
        assert torch.equal(tensor, second[name]), name


@pytest.mark.parametrize(
    "kind",
    [{}, {"features": 2, "offsets": True}, {"rim": "soft"}, {"flat": True}],
    ids=["plain", "extras", "soft rim", "surfels"],
)
def test_threads_and_runs_do_not_change_a_bit(engine, kind):
    inputs = scenes.random_scene(3, **LARGE, **kind, absolute_gradient="features" in kind)
    thresholds = scenes.random_thresholds(3, LARGE["n"])
    alone = everything(engine, inputs, thresholds)
    assert_identical(alone, everything(engine, inputs, thresholds))
    for threads in (2, 3, 7):
        torch.set_num_threads(threads)
        assert_identical(alone, everything(engine, inputs, thresholds))


def test_two_python_threads_at_once(engine):
    cases = [scenes.random_scene(seed, 400, 60, 50) for seed in range(4)]
    expected = [everything(engine, case, None) for case in cases]
    with ThreadPoolExecutor(2) as pool:
        found = list(pool.map(lambda case: everything(engine, case, None), cases * 5))
    for i, result in enumerate(found):
        assert_identical(expected[i % len(cases)], result)


@pytest.mark.parametrize("rim", get_args(Rim))
@pytest.mark.parametrize("compensation", ["none", "antialiasing"])
def test_neutral_thresholds_are_no_thresholds(engine, compensation, rim):
    inputs = scenes.random_scene(5, 200, 70, 50, sh_degree=3, compensation=compensation)
    neutral = torch.sigmoid(torch.full((200,), NEUTRAL_LOGIT))
    found = everything(engine, replace(inputs, rim=rim), neutral)
    assert_identical(everything(engine, inputs, None), found)
    assert not found["grad thresholds"].any() or rim == "hard"


@pytest.mark.parametrize("flat", [False, True])
def test_a_stop_that_no_pixel_reaches_changes_no_bit(engine, flat):
    inputs = scenes.random_scene(4, 60, flat=flat)
    faint = replace(inputs.splats, opacities=inputs.splats.opacities * 0.05)
    inputs, tau = replace(inputs, splats=faint), scenes.random_thresholds(4, 60)
    without = everything(engine, inputs, tau)
    assert without["alpha"].max() < 1 - 1e-4
    assert_identical(without, everything(engine, replace(inputs, stop=1e-4), tau))


@pytest.mark.parametrize(
    ("field", "poison"),
    [
        *product(("means", "opacities", "scales", "rotations", "sh"), (nan, inf, -inf, 1e38)),
        *(("features", poison) for poison in (nan, inf)),
    ],
)
def test_a_broken_gaussian_takes_only_itself_along(engine, field, poison):
    inputs, absent = scenes.random_scene(1, 40, features=2), scenes.random_scene(1, 40, features=2)
    thresholds = scenes.random_thresholds(0, 40)
    assert everything(engine, inputs, thresholds)["fragments_per_gaussian"][11] > 600
    getattr(inputs.splats, field)[11] = poison
    absent.splats.opacities[11] = 0.0
    found, expected = (everything(engine, each, thresholds) for each in (inputs, absent))
    for name in ("image", "features"):
        assert torch.equal(found[name], expected[name])
    others = torch.arange(40) != 11
    for name, tensor in expected.items():
        if name.startswith("grad") and len(tensor) == 40:
            assert torch.equal(found[name][others], tensor[others]), name
            assert not found[name][~others].any(), name


def test_gradients_come_in_the_dtype_and_only_where_they_are_wanted(engine):
    inputs = scenes.random_scene(0, dtype=torch.float64)
    opacities = inputs.splats.opacities.requires_grad_()
    out = engine.rasterize(inputs, None)
    out.image.sum().backward()
    assert opacities.grad.dtype == torch.float64
    assert inputs.splats.means.grad is None


def test_where_torch_puts_new_tensors_by_default_is_nothing_to_it(engine):
    inputs, thresholds = scenes.random_scene(0), scenes.random_thresholds(0, 60)
    expected = engine.rasterize(inputs, thresholds)
    with torch.device("meta"):
        found = engine.rasterize(inputs, thresholds)
    assert torch.equal(found.image, expected.image)
    assert torch.equal(found.fragments_per_pixel, expected.fragments_per_pixel)


def test_subsets_of_gradients_equal_the_whole(engine):
    inputs = scenes.random_scene(4, 120, 50, 40, sh_degree=2, compensation="antialiasing")
    thresholds = scenes.random_thresholds(4, 120)
    made, leaves = scenes.leaves(inputs)
    tau = thresholds.clone().requires_grad_()
    engine.rasterize(made, tau).image.square().sum().backward()
    for name in ("opacities", "means", "sh", "scales"):
        alone = getattr(inputs.splats, name).clone().requires_grad_()
        case = replace(inputs, splats=replace(inputs.splats, **{name: alone}))
        engine.rasterize(case, thresholds).image.square().sum().backward()
        # Lists are tighter without a threshold's gradient; sums run over the same fragments.
        torch.testing.assert_close(alone.grad, leaves[name].grad, rtol=1e-4, atol=1e-4)


def test_backward_twice_and_graph_freed(engine):
    made, leaves = scenes.leaves(scenes.random_scene(0))
    loss = engine.rasterize(made, None).image.sum()
    loss.backward(retain_graph=True)
    first = leaves["means"].grad.clone()
    loss.backward()
    assert torch.equal(leaves["means"].grad, 2 * first)
    with pytest.raises(RuntimeError, match="second time"):
        loss.backward()


def test_memory_used_again_holds_nothing_of_its_past(engine):
    inputs = scenes.random_scene(6, 300, 200, 160)  # images large enough for the workspace
    fresh = everything(engine, inputs, None)
    poison = engine.rasterize(scenes.random_scene(7, 900, 210, 160), None)
    for tensor in (poison.image, poison.invdepth, poison.alpha):
        tensor.fill_(float("nan"))
    del poison, tensor
    assert_identical(fresh, everything(engine, inputs, None))


def test_outputs_and_graphs_outlive_their_engine():
    engine = CpuEngine()
    made, leaves = scenes.leaves(scenes.random_scene(0, 50, 200, 160))
    out = engine.rasterize(made, None)
    expected = out.image.detach().clone()
    del engine
    out.image.sum().backward()
    assert torch.equal(out.image, expected)
    assert leaves["means"].grad.isfinite().all()


def test_stages_are_timed(engine):
    out = engine.rasterize(scenes.random_scene(0), None)
    assert list(out.stages) == ["projection", "binning", "blend"]
    assert all(ms > 0 for ms in out.stages.values())


def test_double_backward_is_refused(engine):
    made, leaves = scenes.leaves(scenes.random_scene(0))
    loss = engine.rasterize(made, None).image.square().sum()
    (grad,) = torch.autograd.grad(loss, leaves["means"], create_graph=True)
    with pytest.raises(RuntimeError, match="once_differentiable"):
        grad.sum().backward()


@pytest.mark.parametrize("planes", [(), ("alpha",), ("invdepth",), ("invdepth", "alpha")])
@pytest.mark.parametrize("kind", [{}, {"features": 2}], ids=["plain", "features"])
def test_a_plane_that_is_not_asked_for_changes_nothing_else(engine, planes, kind):
    inputs = scenes.random_scene(3, 60, 70, 50, **kind)
    thresholds = scenes.random_thresholds(3, 60)
    whole = engine.rasterize(inputs, thresholds)
    some = engine.rasterize(replace(inputs, planes=planes), thresholds)
    assert torch.equal(some.image, whole.image)
    assert torch.equal(some.radii, whole.radii)
    for name in ("invdepth", "alpha"):
        assert torch.equal(getattr(some, name), getattr(whole, name)[: int(name in planes)])


def test_gradients_of_the_image_alone_are_the_same(engine):
    grads = []
    for planes in ((), ("invdepth", "alpha")):
        made, leaves = scenes.leaves(scenes.random_scene(4, 60, 70, 50))
        image = engine.rasterize(replace(made, planes=planes), None).image
        image.square().sum().backward()
        grads.append({name: leaf.grad for name, leaf in leaves.items()})
    for name, grad in grads[0].items():
        assert torch.equal(grad, grads[1][name]), name


def test_a_picture_that_gets_no_gradients_takes_no_trouble_for_them(engine):
    """A trained model's parameters want some wherever they are drawn; rims need more lanes then."""
    inputs, plain = scenes.random_scene(3, 60, 70, 50), scenes.random_thresholds(3, 60)
    expected = engine.rasterize(inputs, plain).evaluated_per_pixel
    made, _ = scenes.leaves(inputs)
    wanting = plain.clone().requires_grad_()
    assert engine.rasterize(made, wanting).evaluated_per_pixel > expected
    with torch.no_grad():
        assert engine.rasterize(made, wanting).evaluated_per_pixel == expected
