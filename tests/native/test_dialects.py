"""What some dialects ask for beyond the plain picture, alone and mixed, against the oracle.

The rules of test_against_oracle.py apply: both engines see the same float32 numbers, and pixels
whose fragment counts differ by rounding are few and left out.
"""

import math
from dataclasses import replace
from typing import get_args

import pytest
import scenes
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from native.test_against_oracle import (
    check_gradients,
    check_images,
    check_scores,
    draw_pair,
    expect_oracle,
    gradients,
    projected,
)

from fragprune_plugins.engines.reference import ReferenceEngine
from fragprune_plugins.types import Compensation, RasterInputs, Rim

Case = tuple[RasterInputs, torch.Tensor | None]


@st.composite
def dialects(draw: st.DrawFn) -> Case:
    """Everything mixed: splats or footprints, some truncated; sizes are no tiles."""
    one_of = lambda *values: draw(st.sampled_from(values))  # noqa: E731
    seed, n = draw(st.integers(0, 2**20)), one_of(0, 1, 2, 9, 40)
    width, height = one_of((1, 1), (7, 33), (17, 15), (35, 21))
    switches = ("offsets", "cap_gradient", "absolute_gradient", "scores", "colors", "cov3d")
    inputs = scenes.random_scene(
        seed,
        n,
        width,
        height,
        features=one_of(0, 1, 2, 3, 8),
        compensation=one_of(*get_args(Compensation)),
        dilation=one_of(0.05, 0.1, 0.3),
        near=one_of(0.05, 0.2, 2.0),
        alpha_max=one_of(0.7, 0.99, 0.999),
        stop=one_of(None, 0.01, 0.5),
        rim=one_of(*get_args(Rim)),
        **{name: draw(st.booleans()) for name in switches},
    )
    if draw(st.booleans()):
        inputs = projected(inputs)
    return inputs, scenes.random_thresholds(seed, n) if draw(st.booleans()) else None


@settings(max_examples=60)
@given(case=dialects())
def test_all_mixed_equal_the_oracle(engine, case):
    inputs, thresholds = case
    truth, ours, same = draw_pair(engine, inputs, thresholds)
    if not torch.equal(truth.radii, ours.radii):
        assert (truth.radii - ours.radii).abs().max() <= 1
        return  # 3 sigma within rounding of an integer: a whole tile more or less, rightly
    check_images(truth, ours, same)
    # In images of a few pixels the terms of a gradient may cancel, with nothing to average over.
    check_gradients(engine, inputs, thresholds, same, 1e-2)
    if inputs.scores:
        check_scores(truth, ours, same)


def test_scores_and_features_change_nothing_else(engine):
    inputs = scenes.random_scene(4, 200, 61, 43)
    features = torch.rand(200, 5, generator=torch.Generator().manual_seed(0))
    asked = replace(
        inputs,
        splats=replace(inputs.splats, features=features),
        scores=True,
        absolute_gradient=True,
        sample_offsets=torch.zeros(43, 61, 2),
    )
    plain, more = engine.rasterize(inputs, None), engine.rasterize(asked, None)
    for name in ("image", "invdepth", "alpha", "radii"):
        assert torch.equal(getattr(plain, name), getattr(more, name)), name
    alone = replace(inputs, splats=replace(inputs.splats, features=features[:, :1].contiguous()))
    assert torch.equal(engine.rasterize(alone, None).features, more.features[:1])
    same = torch.ones(43, 61, dtype=torch.bool)
    asked = replace(asked, splats=inputs.splats)
    first, second = (gradients(engine, case, None, same, 0.0) for case in (inputs, asked))
    for name, grad in first.items():
        columns = slice(0, 2) if name == "means2d_hook" else slice(None)
        assert torch.equal(grad[..., columns], second[name][..., columns]), name


def test_features_without_a_gradient_from_above_get_zeros(engine):
    made, leaves = scenes.leaves(scenes.random_scene(0, features=2))
    engine.rasterize(made, None).image.sum().backward()
    assert leaves["features"].grad is None or not leaves["features"].grad.any()
    assert leaves["means"].grad.any()


def test_footprints_that_cannot_be_drawn_are_culled(engine):
    scene = scenes.footprints_of(scenes.stack([0.5] * 9))
    splats = scene.splats
    splats.conics[0, 0] = -1.0
    splats.conics[1, 1] = 9.0
    splats.depths[2] = 0.0
    splats.tiles[3] = torch.tensor([1, 1, 1, 2], dtype=torch.int32)
    splats.means2d[4, 0] = math.nan
    splats.depths[5] = math.inf
    splats.opacities[6] = math.nan
    splats.tiles[7] = torch.tensor([-(2**31), -5, 2**31 - 1, 2**31 - 1], dtype=torch.int32)
    made, leaves = scenes.leaves(scene)
    drawn = engine.rasterize(replace(made, counts=True), None)
    assert (drawn.fragments_per_gaussian > 0).tolist() == [False] * 7 + [True] * 2
    drawn.image.sum().backward()
    for name in ("means2d", "conics", "opacities", "colors"):
        assert not leaves[name].grad[:7].any(), name
        assert leaves[name].grad.isfinite().all(), name


def test_offsets_beyond_all_bounds_are_refused(engine):
    from fragprune_plugins.errors import EngineError

    inputs = scenes.random_scene(0)
    for wild in (math.nan, math.inf, 2e6):
        offsets = torch.zeros(28, 40, 2)
        offsets[3, 4, 1] = wild
        with pytest.raises(EngineError, match="sample_offsets"):
            engine.rasterize(replace(inputs, sample_offsets=offsets), None)


@pytest.mark.parametrize("far", [3.0, 40.0])
def test_offsets_may_reach_far(engine, far):
    inputs = scenes.random_scene(3, 60, 41, 29, offsets=True)
    inputs = replace(inputs, sample_offsets=inputs.sample_offsets * 2 * far)
    expect_oracle(engine, inputs, None)


@pytest.mark.parametrize(
    ("side", "dilation"), [(0.0315, 0.0), (0.0318, 0.0), (0.0589, 0.4), (0.1, 0.1), (0.5, 0.1)]
)
def test_mips_small_numbers_count_where_determinants_are_small(engine, side, dilation):
    scene = scenes.one_splat(sigma=(side, side), opacity=0.99)
    scene = replace(scene, compensation="mip", dilation=dilation)
    found = []
    for draws, case in ((engine, scene), (ReferenceEngine(), scenes.cast(scene, torch.float64))):
        made, leaves = scenes.leaves(case)
        drawn = draws.rasterize(replace(made, counts=True), None)
        assert (drawn.fragments.sum() > 0).item() is (side > 0.0316)
        drawn.image[:, 8, 8].sum().backward()
        alpha = drawn.alpha[0, 8, 8].item()
        found.append([alpha, leaves["opacities"].grad.item(), leaves["scales"].grad[0, 0].item()])
    # 1e-6 in a ratio of 2.4e-5 moves alpha by 2%.
    assert found[0] == pytest.approx(found[1], rel=1e-3)
