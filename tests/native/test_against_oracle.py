"""The cpu engine against the oracle in float64: images and every gradient.

Both see the same numbers: scenes are float32 and cast to float64 for the oracle, so what differs is
our arithmetic alone. A fragment whose q lies within that rounding of a cut may be drawn by one and
not by the other, a pixel's stop likewise: pixels with unequal fragment counts are left out of the
comparison and of the loss, and must be few. What is left differs by accumulated float32 rounding.
"""

import math
from collections.abc import Callable
from dataclasses import fields, is_dataclass, replace
from typing import Any, get_args

import pytest
import scenes
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from fragprune_plugins.constants import NEAR, TILE
from fragprune_plugins.engines.cpu.engine import CpuEngine
from fragprune_plugins.engines.reference import ReferenceEngine
from fragprune_plugins.types import RasterInputs, RasterOutputs, Rim, Splats

IMAGE_TOLERANCE = 2e-5
"""About 2^-23 times the fragments of a pixel, twice over; 2e-6 is what most scenes show."""

GRADIENT_TOLERANCE = 3e-4
"""Of the largest entry: sums of a thousand terms of both signs, divided by 1 - alpha >= 0.01."""

KINDS = {
    "plain": {},
    "sh 3, antialiasing": {"sh_degree": 3, "compensation": "antialiasing"},
    "cov3d": {"cov3d": True},
    "cov3d, antialiasing": {"cov3d": True, "compensation": "antialiasing", "sh_degree": 0},
    "colours, modifier": {"colors": True, "scale_modifier": 0.7},
    "odd size, sh 2": {"width": 33, "height": 17, "sh_degree": 2},
    "stopped": {"stop": 0.3},
    "mip": {"compensation": "mip", "dilation": 0.1},
    "near": {"near": 2.5},
    "scores": {"scores": True},
    "offsets": {"offsets": True},
    "absolute gradient": {"absolute_gradient": True},
    "low cap": {"alpha_max": 0.5},
    "capped gradient": {"alpha_max": 0.6, "cap_gradient": False},
    "no cap": {"alpha_max": 1.0, "cap_gradient": False},
    "1 feature": {"features": 1},
    "8 features": {"features": 8},
    "features, colours, offsets": {"features": 3, "colors": True, "offsets": True},
    "stopped, with features and scores": {"stop": 0.2, "features": 2, "scores": True},
    "soft rim": {"rim": "soft", "offsets": True, "absolute_gradient": True},
    "soft rim, with a capped gradient": {"rim": "soft", "alpha_max": 0.6, "cap_gradient": False},
    "soft rim, antialiasing, cov3d, stopped": {
        "rim": "soft",
        "compensation": "antialiasing",
        "cov3d": True,
        "stop": 0.3,
    },
    "surfels": {"flat": True},
    "surfels, sh 3, modifier": {"flat": True, "sh_degree": 3, "scale_modifier": 0.7, "width": 33},
    "surfels, colours": {"flat": True, "colors": True},
    "surfels, near": {"flat": True, "near": 2.5},
    "surfels, low cap": {"flat": True, "alpha_max": 0.5},
    "surfels, capped gradient": {"flat": True, "alpha_max": 0.6, "cap_gradient": False},
    "surfels, stopped, scores": {"flat": True, "stop": 0.2, "scores": True},
}


def draw_pair(engine, inputs, thresholds):
    """Both engines' outputs without gradients, and where their fragment counts agree, (H, W)."""
    truth = once(true_picture, inputs, thresholds)
    with torch.no_grad():
        ours = engine.rasterize(replace(inputs, counts=True), thresholds)
    return truth, ours, truth.fragments == ours.fragments


@torch.no_grad()
def true_picture(inputs: RasterInputs, thresholds: torch.Tensor | None) -> RasterOutputs:
    wide = replace(scenes.cast(inputs, torch.float64), counts=True)
    return ReferenceEngine().rasterize(wide, None if thresholds is None else thresholds.double())


def true_gradients(inputs, thresholds, same):
    tau = None if thresholds is None else thresholds.double()
    return gradients(ReferenceEngine(), scenes.cast(inputs, torch.float64), tau, same, 5.0)


_DONE: dict[Any, Any] = {}


def once(work: Callable[..., Any], *given: Any) -> Any:
    """What the oracle makes of these inputs, worked out for the first of all builds."""
    key = work, digest(given)
    if key not in _DONE:
        _DONE[key] = work(*given)
    return _DONE[key]


def digest(value: Any) -> Any:
    """Tells inputs apart by all of their numbers."""
    if isinstance(value, torch.Tensor):
        return value.dtype, value.shape, hash(value.detach().numpy().tobytes())
    if is_dataclass(value):
        return tuple(digest(getattr(value, each.name)) for each in fields(value))
    return tuple(map(digest, value)) if isinstance(value, tuple) else value


def check_images(truth, ours, same, tolerance=IMAGE_TOLERANCE):
    assert (~same).sum() <= 1 + same.numel() // 500
    for name in ("image", "invdepth", "alpha", "features", "surface"):
        expected = getattr(truth, name)
        if expected is None:
            assert getattr(ours, name) is None
            continue
        difference = (expected - getattr(ours, name))[:, same].abs()
        scale = max(1.0, expected.abs().max().item())
        assert difference.numel() == 0 or difference.max() < tolerance * scale, name
    assert ours.fragments is not None
    assert ours.fragments.sum() == ours.fragments_per_gaussian.sum()
    mean = ours.fragments.double().mean()
    assert ours.fragments_per_pixel.item() == pytest.approx(mean.item(), rel=1e-6)
    assert ours.evaluated_per_pixel >= mean


def test_large_pictures_are_written_whole_past_the_caches(engine):
    """Their rows are lines of memory, 262,144 pixels or more, the lowest tiles cut.

    Coordinates are ten times the other scenes', and a float's distance between them.
    """
    inputs = scenes.random_scene(5, 60, width=528, height=500, features=2)
    pair = draw_pair(engine, inputs, scenes.random_thresholds(5, 60))
    check_images(*pair, tolerance=10 * IMAGE_TOLERANCE)


def gradients(engine, inputs, thresholds, same, pressure):
    """Of one loss that uses every output, by leaf name."""
    made, leaves = scenes.leaves(inputs)
    if thresholds is not None:
        leaves["thresholds"] = thresholds = thresholds.detach().clone().requires_grad_()
    out = engine.rasterize(made, thresholds)
    generator = torch.Generator().manual_seed(7)
    loss = out.image.new_zeros(())
    for tensor in (out.image, out.invdepth, out.alpha, out.features, out.surface):
        if tensor is None:
            continue
        weight = torch.randn(tensor.shape, generator=generator) * same
        loss = loss + (tensor * weight.to(tensor.dtype)).sum()
    if thresholds is not None:
        loss = loss + pressure * out.fragments_per_pixel
    loss.backward()
    return {name: leaf.grad for name, leaf in leaves.items() if leaf.grad is not None}


def check_gradients(engine, inputs, thresholds, same, tolerance=GRADIENT_TOLERANCE):
    truth = once(true_gradients, inputs, thresholds, same)
    ours = gradients(engine, inputs, thresholds, same, 5.0)
    for name, expected in truth.items():
        found = ours[name]
        assert found.shape == expected.shape
        assert found.isfinite().all(), name
        if expected.numel():
            scale = expected.abs().max().item() + 1e-2  # terms that cancel leave their rounding
            assert (found - expected).abs().max().item() < tolerance * scale, name


def check_scores(truth: RasterOutputs, ours: RasterOutputs, same: torch.Tensor) -> None:
    """Weights and winners where rounding does not decide."""
    agree = truth.winners == ours.winners
    assert (~agree & same).sum() <= 1 + same.numel() // 500
    assert torch.equal(ours.winners >= 0, ours.fragments > 0)
    wins = ours.winners[ours.winners >= 0].bincount(minlength=len(ours.radii))
    assert torch.equal(wins.int(), ours.wins_per_gaussian)
    away = (truth.weights_per_gaussian - ours.weights_per_gaussian).abs()
    assert (away <= 1e-5 * truth.weights_per_gaussian + 1.0 * (~same).sum() + 1e-6).all()
    light = ours.alpha.double().sum().item()
    assert ours.weights_per_gaussian.double().sum().item() == pytest.approx(light, rel=1e-5)


def expect_oracle(engine: CpuEngine, inputs: RasterInputs, thresholds: torch.Tensor | None) -> None:
    """Radii, images, counts and gradients, and scores where they are asked for."""
    truth, ours, same = draw_pair(engine, inputs, thresholds)
    assert torch.equal(truth.radii, ours.radii)
    check_images(truth, ours, same)
    check_gradients(engine, inputs, thresholds, same)
    if inputs.scores:
        check_scores(truth, ours, same)


def projected(inputs: RasterInputs) -> RasterInputs:
    """The same as footprints of float32, projected in float64."""
    return scenes.cast(scenes.footprints_of(scenes.cast(inputs, torch.float64)), torch.float32)


@pytest.mark.parametrize(
    ("kind", "how"),
    [
        (kind, how)
        for kind in KINDS
        for how in ("whole", "truncated", "projected before")
        if how != "projected before" or "flat" not in KINDS[kind]
    ],
)
def test_images_and_gradients_equal_the_oracle(engine, kind, how):
    inputs = scenes.random_scene(5, **KINDS[kind])
    if how == "projected before":
        inputs = projected(inputs)
    expect_oracle(engine, inputs, None if how == "whole" else scenes.random_thresholds(5, 60))


@pytest.mark.parametrize("stop", [None, 1e-4, 0.011, 1.0])
def test_tall_stacks_stop_where_the_oracle_does(engine, stop):
    inputs = replace(scenes.stack([0.3, 0.9, 0.999, 0.5] * 90), stop=stop)
    thresholds = torch.linspace(0.01, 0.6, 360)  # more than is staged at once
    expect_oracle(engine, inputs, thresholds)


@pytest.mark.parametrize("scene", [scenes.empty(), scenes.behind_camera()])
def test_nothing_to_draw_leaves_the_background(engine, scene):
    _, ours, same = draw_pair(engine, scene, None)
    assert same.all()
    assert torch.equal(ours.image, scene.view.background[:, None, None].expand_as(ours.image))
    assert not ours.radii.any()
    check_gradients(engine, scene, None, same)


def test_changes_in_place_are_noticed(engine):
    made, leaves = scenes.leaves(scenes.random_scene(0))
    loss = engine.rasterize(made, None).image.sum()
    with torch.no_grad():
        leaves["opacities"].mul_(0.5)
    with pytest.raises(RuntimeError, match="inplace"):
        loss.backward()


@st.composite
def awkward_scenes(draw: st.DrawFn) -> tuple[RasterInputs, torch.Tensor | None]:
    """Tiny odd images; needles, sheets, points, giants and sub-pixel splats; many off the image."""
    generator = torch.Generator().manual_seed(draw(st.integers(0, 2**20)))
    n = draw(st.sampled_from([0, 1, 2, 5, 9]))
    view = scenes.random_view(generator, draw(st.integers(1, 37)), draw(st.integers(1, 35)))

    def uniform(low: float, high: float, *shape: int) -> torch.Tensor:
        return torch.rand(*shape, generator=generator, dtype=torch.float64) * (high - low) + low

    size = torch.tensor([view.width, view.height]).double()
    pixels = uniform(-0.6, 1.6, n, 2) * size
    depths = torch.where(torch.rand(n, generator=generator) < 0.15, -1.0, uniform(0.25, 6, n))
    largest = draw(st.sampled_from([0.05, 1.0, 30.0, 3000.0]))  # pixels
    scales = largest * torch.exp(uniform(-6.0, 0.0, n, 3)) * (depths.abs() / view.width)[:, None]
    if draw(st.booleans()):
        scales[:, draw(st.integers(0, 2))] = 0.0
    splats = Splats(
        means=scenes.unproject(view, pixels, depths),
        opacities=uniform(0.001, 1.0, n),
        scales=scales,
        rotations=torch.randn(n, 4, generator=generator, dtype=torch.float64),
        colors=uniform(0.0, 1.0, n, 3),
    )
    if n and draw(st.booleans()):
        splats = replace(splats, rotations=torch.nn.functional.normalize(splats.rotations, dim=1))
    if draw(st.booleans()):
        splats = scenes.with_cov3d(splats)
    thresholds = scenes.random_thresholds(n, n) if draw(st.booleans()) else None
    inputs = RasterInputs(
        view,
        splats,
        compensation=draw(st.sampled_from(["none", "antialiasing"])),
        rim=draw(st.sampled_from(get_args(Rim))),
    )
    return scenes.cast(inputs, torch.float32), thresholds


@settings(max_examples=30)
@given(case=awkward_scenes())
def test_awkward_scenes_equal_the_oracle(engine, case):
    inputs, thresholds = case
    truth, ours, same = draw_pair(engine, inputs, thresholds)
    away = (truth.radii - ours.radii).abs()
    assert (away <= 1 + 1e-6 * truth.radii).all()
    if away.any():
        return  # 3 sigma within rounding of an integer: a whole tile more or less, rightly
    check_images(truth, ours, same, 1e-4)
    # Rounding of a mean far off the image moves a giant splat by 1e-4 pixels and more. A needle's
    # covariance has a condition number of (length / width)^2, the width at least the dilation's
    # 0.55 pixels: that many times 2^-24 is lost from the gradients of its shape. And in images of
    # a pixel or two the terms of a gradient may cancel, with nothing to average over.
    sigma = max([0, *truth.radii.tolist()]) / 3
    check_gradients(engine, inputs, thresholds, same, 1e-2 + (sigma / 0.55) ** 2 * 2.0**-24)


Drawn = tuple[RasterInputs, torch.Tensor | None]


def placed(scene, pixels, depths, sigma):
    """The same splats of a scene in float64, at other places and sigma pixels (N, 3) large."""
    view = scene.view
    scales = sigma * (depths.abs() * 2 * view.tan_fov_x / view.width)[:, None]
    means = scenes.unproject(view, pixels, depths)
    return replace(scene, splats=replace(scene.splats, means=means, scales=scales))


def uniform(seed: int, low: float, high: float, *shape: int) -> torch.Tensor:
    generator = torch.Generator().manual_seed(seed)
    return torch.rand(*shape, generator=generator, dtype=torch.float64) * (high - low) + low


@st.composite
def opaque_borders(draw: st.DrawFn) -> Drawn:
    """Opaque splats piled on the borders of tiles: pixels beside one another stop, in four tiles.

    Images end inside a tile, and some lists are longer than one batch of the engine.
    """
    seed, n = draw(st.integers(0, 2**20)), draw(st.sampled_from([8, 60, 300]))
    size = draw(st.sampled_from([(17, 19), (31, 33), (47, 18), (40, 50)]))
    scene = scenes.random_scene(seed, n, *size, colors=True, dtype=torch.float64)
    corners = torch.tensor(size).double() / TILE
    border = (uniform(seed, 0.4, 1.0, n, 2) * corners).round() * TILE - 0.5
    pixels = border + uniform(seed + 1, -1.0, 1.0, n, 2)
    sigma = uniform(seed + 2, math.log(0.7), math.log(12.0), n, 3).exp()
    scene = placed(scene, pixels, uniform(seed + 3, 1.0, 6.0, n), sigma)
    scene = replace(scene, splats=replace(scene.splats, opacities=uniform(seed + 4, 0.5, 1.0, n)))
    thresholds = scenes.random_thresholds(n, n) if draw(st.booleans()) else None
    return scenes.cast(scene, torch.float32), thresholds


@settings(max_examples=25)
@given(case=opaque_borders())
def test_pixels_stop_alike_on_both_sides_of_a_border(engine, case):
    truth, ours, same = draw_pair(engine, *case)
    check_images(truth, ours, same)
    # One fragment where the rim's reach ends, 4% of the peak, may count for one engine only.
    check_gradients(engine, *case, same, tolerance=1e-2)
    if case[1] is None and len(case[0].splats) == 300:
        assert (truth.alpha > 0.999).sum() > 10  # the pile is deep enough to stop pixels


@st.composite
def near_the_near_plane(draw: st.DrawFn) -> Drawn:
    """Gaussians just before and just behind the near plane, on the image and far beside it."""
    seed, n = draw(st.integers(0, 2**20)), draw(st.sampled_from([1, 2, 9]))
    size = draw(st.sampled_from([(1, 40), (33, 1), (30, 23)]))
    scene = scenes.random_scene(seed, n, *size, colors=True, dtype=torch.float64)
    side = uniform(seed, -1.0, 1.0, n).sign()
    depths = NEAR + side * uniform(seed + 1, math.log(1e-4), math.log(0.1), n).exp()
    pixels = uniform(seed + 2, -1.5, 2.5, n, 2) * torch.tensor(size)
    sigma = uniform(seed + 3, math.log(0.1), math.log(50.0), n, 3).exp()
    return scenes.cast(placed(scene, pixels, depths, sigma), torch.float32), None


@settings(max_examples=30)
@given(case=near_the_near_plane())
def test_the_near_plane_culls_alike(engine, case):
    truth, ours, same = draw_pair(engine, *case)
    assert torch.equal(truth.radii > 0, ours.radii > 0)
    if not torch.equal(truth.radii, ours.radii):
        return
    # A depth of 0.2 is what is left of coordinates of 2: ten times the usual rounding, all through.
    check_images(truth, ours, same, tolerance=2e-4)
    check_gradients(engine, *case, same, tolerance=3e-3)
