"""Surfels on the cpu engine; what all Gaussians have in common is in test_against_oracle.py."""

from collections.abc import Callable
from dataclasses import replace

import pytest
import scenes
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from native.test_against_oracle import GRADIENT_TOLERANCE, check_images, draw_pair
from native.test_inputs import draw

from fragprune_plugins.engines.calling import native_arrays, native_inputs
from fragprune_plugins.engines.cpu import binding
from fragprune_plugins.engines.reference import ReferenceEngine
from fragprune_plugins.types import RasterInputs, RasterOutputs

MAPS: dict[str, Callable[[RasterOutputs], torch.Tensor]] = {
    "alpha": lambda drawn: drawn.alpha,
    "depth": lambda drawn: drawn.surface[:1],
    "normal": lambda drawn: drawn.surface[1:4],
    "median depth": lambda drawn: drawn.surface[4:5],
    "distortion": lambda drawn: drawn.surface[5:],
}
"""What regularisers read. In a sum of all, the distortion is lost: it is a thousand times less."""


def sheet(seed: int) -> RasterInputs:
    """Surfels on one plane before the camera, or 1 % of its depth away: what regularisers make."""
    scene = scenes.random_scene(seed, 60, flat=True)
    view = scenes.one_splat(width=40, height=28).view  # the world is the camera's
    generator = torch.Generator().manual_seed(seed)
    at = torch.rand(60, 2, generator=generator) * torch.tensor([40.0, 28.0])
    depths = 3 + 0.03 * torch.randn(60, generator=generator)
    turns = torch.nn.functional.normalize(
        torch.tensor([[1.0, 0, 0, 0]]) + 0.03 * torch.randn(60, 4, generator=generator)
    )
    splats = replace(scene.splats, means=scenes.unproject(view, at, depths), rotations=turns)
    return replace(scene, view=view, splats=splats)


def slopes(drawn, leaves, plane, same):
    """Derivatives of a sum over one plane, its pixels weighted at random, by leaf name."""
    weight = torch.randn(plane(drawn).shape, generator=torch.Generator().manual_seed(7)) * same
    (plane(drawn) * weight.to(drawn.image)).sum().backward()
    return {name: leaf.grad for name, leaf in leaves.items() if leaf.grad is not None}


@pytest.mark.parametrize("truncated", [False, True], ids=["whole", "truncated"])
@pytest.mark.parametrize("plane", MAPS)
@pytest.mark.parametrize("made", [lambda: scenes.random_scene(2, flat=True), lambda: sheet(3)])
def test_each_map_alone_and_its_gradients_equal_the_oracle(engine, made, plane, truncated):
    scene, drawn = made(), MAPS[plane]
    tau = scenes.random_thresholds(2, 60) if truncated else None
    truth, ours, same = draw_pair(engine, scene, tau)
    same &= (truth.surface[4] - ours.surface[4]).abs() < 1e-3  # half of the light, to rounding
    assert (~same).sum() <= 2
    error = (drawn(truth) - drawn(ours))[:, same].abs().max()
    assert error < GRADIENT_TOLERANCE * drawn(truth)[:, same].abs().max()
    found = []
    for each, dtype in ((ReferenceEngine(), torch.float64), (engine, torch.float32)):
        cast, leaves = scenes.leaves(scenes.cast(scene, dtype))
        if tau is not None:
            leaves["thresholds"] = tau.detach().to(dtype).requires_grad_()
        found.append(slopes(each.rasterize(cast, leaves.get("thresholds")), leaves, drawn, same))
    for name, expected in found[0].items():
        away = (found[1][name] - expected).abs().max()
        assert away <= GRADIENT_TOLERANCE * expected.abs().max(), name


@settings(max_examples=25)
@given(
    seed=st.integers(0, 2**20),
    n=st.sampled_from([0, 1, 9, 40]),
    size=st.sampled_from([(1, 1), (7, 33), (17, 15), (35, 21)]),
    truncated=st.booleans(),
)
def test_pictures_of_any_size_equal_the_oracle(engine, seed, n, size, truncated):
    scene = scenes.random_scene(seed, n, *size, flat=True)
    truth, ours, same = draw_pair(
        engine, scene, scenes.random_thresholds(seed, n) if truncated else None
    )
    if not torch.equal(truth.radii, ours.radii):
        assert (truth.radii - ours.radii).abs().max() <= 1
        return  # within rounding of an integer: a whole tile more or less, rightly
    same &= (truth.surface[4] - ours.surface[4]).abs() < 1e-3  # half of the light, to rounding
    # Depths of surfels that are seen from the side: a division by what is left of cancelling terms.
    check_images(truth, ours, same, 1e-3)


def test_thresholds_spare_what_they_cut_off(engine):
    scene = scenes.random_scene(5, 300, 160, 120, flat=True)
    whole = engine.rasterize(scene, None)
    cut = engine.rasterize(scene, torch.full((300,), 0.5))
    assert cut.fragments_per_pixel < 0.7 * whole.fragments_per_pixel
    assert cut.evaluated_per_pixel < 0.7 * whole.evaluated_per_pixel
    assert cut.entries_per_pixel < 0.8 * whole.entries_per_pixel


def test_a_surface_is_drawn_where_it_is_asked_for(engine):
    scene = scenes.random_scene(6, 20, flat=True)
    assert engine.rasterize(replace(scene, planes=("alpha",)), None).surface is None
    assert engine.rasterize(replace(scene, planes=("surface",)), None).surface.shape == (6, 28, 40)
    round_ones = scenes.random_scene(6, 20)
    assert engine.rasterize(round_ones, None).surface is None


@pytest.mark.parametrize(
    "change",
    [{"features": 2}, {"offsets": True}, {"compensation": "mip"}, {"cov3d": True}, {"rim": "soft"}],
    ids=lambda change: next(iter(change)),
)
def test_what_surfels_do_not_have_is_refused_by_compiled_code(change):
    scene = scenes.random_scene(6, 40, **change)
    arrays = native_arrays(scene, None)
    struct = native_inputs(scene, arrays, widen=False)
    struct.flat = 1
    status, message = draw(binding.library(), struct)
    assert status != binding.OK
    assert "flat Gaussians" in message
