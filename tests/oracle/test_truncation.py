"""Thresholds: what they cut, what they must leave alone, and what gradient they get."""

from dataclasses import replace

import pytest
import scenes
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from oracle import naive

from fragprune_plugins import rasterize
from fragprune_plugins.engines.reference import camera_of, gaussians_of
from reference_renderer import Options, project, render
from reference_renderer.fragment import fragments

F64 = torch.float64
N, WIDTH, HEIGHT = 40, 34, 20
few = settings(max_examples=25)


def scene_of(seed, **kind):
    return scenes.random_scene(seed, N, WIDTH, HEIGHT, dtype=F64, **kind)


def draw(inputs, thresholds=None):
    return rasterize(replace(inputs, counts=True), thresholds, engine="reference")


def weights():
    generator = torch.Generator().manual_seed(5)
    return torch.rand(4, HEIGHT, WIDTH, generator=generator, dtype=F64) - 0.3


def loss_of(drawn):
    """Linear in colour and inverse depth, so that its derivative per pixel is known."""
    return (torch.cat([drawn.image, drawn.invdepth]) * weights()).sum()


def eligible(inputs, thresholds, options):
    """(K, H W) bool: the pairs that thresholds and the 1/255 skip let through, tiles aside."""
    camera, gaussians = camera_of(inputs), gaussians_of(inputs.splats)
    rows = project.rows_in_front(camera, gaussians.means, options.near)
    prints = project.project(camera, gaussians.take(rows), options)
    ys, xs = torch.arange(HEIGHT, dtype=F64), torch.arange(WIDTH, dtype=F64)
    pixels = torch.cartesian_prod(ys, xs).flip(1)
    return fragments(prints, pixels, thresholds[rows], options).drawn


raises = st.lists(st.floats(0, 0.9), min_size=N, max_size=N)


@few
@given(seed=st.integers(0, 2**31), rise=raises, rim=st.sampled_from(["hard", "soft"]))
def test_raising_thresholds_never_makes_a_pair_eligible(seed, rise, rim):
    inputs, low = scene_of(seed), scenes.random_thresholds(seed, N, dtype=F64)
    high = low + (1 - low) * torch.tensor(rise, dtype=F64)
    options = Options(transmittance_min=0, rim=rim)
    assert not (eligible(inputs, high, options) & ~eligible(inputs, low, options)).any()
    # With the pixel's stop out of the way, drawn is eligible in the host's tiles.
    gaussians = gaussians_of(inputs.splats)
    counts = [
        render(camera_of(inputs), gaussians, tau, options=options).fragments_per_gaussian
        for tau in (low, high)
    ]
    assert (counts[1] <= counts[0]).all()


@few
@given(seed=st.integers(0, 2**31), rim=st.sampled_from(["hard", "soft"]))
def test_neutral_thresholds_change_no_bit_of_image_or_gradient(seed, rim):
    results = []
    neutral = torch.sigmoid(torch.full((N,), -30.0))
    for tau in (None, neutral):
        made = scenes.random_scene(seed, N, WIDTH, HEIGHT, rim="hard" if tau is None else rim)
        inputs, leaves = scenes.leaves(made)
        drawn = draw(inputs, tau)
        (drawn.image.square().sum() + drawn.invdepth.sum() + drawn.alpha.sum()).backward()
        tensors = [drawn.image, drawn.invdepth, drawn.alpha, drawn.radii, drawn.fragments]
        results.append(tensors + [leaf.grad for leaf in leaves.values()])
    assert all(torch.equal(a, b) for a, b in zip(*results, strict=True))


@few
@given(seed=st.integers(0, 2**31))
def test_thresholds_never_change_radii_or_what_is_evaluated(seed):
    inputs, tau = scene_of(seed), scenes.random_thresholds(seed, N, dtype=F64)
    whole, cut = draw(inputs), draw(inputs, tau)
    assert torch.equal(whole.radii, cut.radii)
    assert whole.evaluated_per_pixel == cut.evaluated_per_pixel


def test_a_fragment_is_drawn_exactly_down_to_its_threshold():
    scene = scenes.one_splat(opacity=0.9, dtype=F64)
    falloff = draw(scene).alpha[0, 8, 11].item() / 0.9
    for factor, drawn in ((1 - 1e-9, 1), (1 + 1e-9, 0)):
        tau = torch.tensor([falloff * factor], dtype=F64)
        assert draw(scene, tau).fragments[8, 11] == drawn


def explicit_gradients(inputs, tau, pressure):
    """dL/dtau by the double loop: rim fragments before the stop, drawn or not.

    -sum alpha s(1-s)/w dL/dalpha, where dL/dalpha = T (c - C_behind) dL/dC, with T and C_behind
    untouched at fragments that are not drawn, and behind a stop what its last fragment looks like;
    and -sum s(1-s)/w per pixel for the pressure.
    """
    result = [0.0] * N
    background = [*inputs.view.background.tolist(), 0.0]
    splats, weight = naive.splats_of(inputs, tau), weights().tolist()
    for y in range(HEIGHT):
        for x in range(WIDTH):
            records, light = naive.records_at(splats, x, y, stop=inputs.stop)
            seen = background
            if inputs.stop and light < inputs.stop:
                last = [r for r in records if r.drawn][-1]
                seen = [*last.color, 1 / last.depth]
            behind = [light * b for b in seen]  # what all later fragments add
            for r in reversed(records):
                feature = [*r.color, 1 / r.depth]
                after = r.light * (1 - r.alpha) if r.drawn else r.light
                slope = sum(
                    weight[k][y][x] * r.light * (feature[k] - behind[k] / after) for k in range(4)
                )
                result[r.row] -= (r.alpha * slope + pressure / (WIDTH * HEIGHT)) * r.slope
                if r.drawn:
                    behind = [
                        b + r.alpha * r.light * f for b, f in zip(behind, feature, strict=True)
                    ]
    return torch.tensor(result, dtype=F64)


@pytest.mark.parametrize("pressure", [0.0, 300.0])
@pytest.mark.parametrize(
    "kind", [{}, {"compensation": "antialiasing"}, {"compensation": "mip"}, {"stop": 0.3}], ids=str
)
def test_the_threshold_gradient_is_the_explicit_rim_sum(pressure, kind):
    inputs = scene_of(11, **kind)
    tau = scenes.random_thresholds(11, N, dtype=F64).requires_grad_()
    drawn = draw(inputs, tau)
    (loss_of(drawn) + pressure * drawn.fragments_per_pixel).backward()
    expected = explicit_gradients(inputs, tau.detach(), pressure)
    assert expected.abs().max() > 1
    assert torch.allclose(tau.grad, expected, rtol=1e-7, atol=1e-9)


def test_a_fragment_just_below_its_threshold_still_pulls_on_it():
    scene = scenes.one_splat(opacity=0.9, dtype=F64)
    falloff = draw(scene).alpha[0, 8, 11].item() / 0.9
    for distance, felt in ((0.045, True), (0.047, False)):
        tau = torch.tensor([falloff + distance], dtype=F64, requires_grad=True)
        drawn = draw(scene, tau)
        assert drawn.fragments[8, 11] == 0
        drawn.image[:, 8, 11].sum().backward()
        assert (tau.grad != 0).item() is felt


def test_fragments_too_faint_for_the_host_pull_on_no_threshold():
    scene = scenes.one_splat(opacity=0.003, dtype=F64)
    tau = torch.tensor([0.5], dtype=F64, requires_grad=True)
    drawn = draw(scene, tau)
    (drawn.image.sum() + drawn.fragments_per_pixel).backward()
    assert drawn.fragments.sum() == 0
    assert drawn.radii.item() > 0
    assert tau.grad.item() == 0
