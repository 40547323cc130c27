"""The 3D Gaussians and colours of a moment, against another way to say the same, in float64."""

import math

import numpy as np
import pytest
import torch
from oracle.naive import harmonic

from reference_renderer import SpacetimeGaussians, color4d, slice4d, slice_gaussians
from reference_renderer.color4d import Clock

F64 = torch.float64
COUNT = 12
NOW = 0.3


def random(*shape, seed=0):
    return torch.randn(*shape, generator=torch.Generator().manual_seed(seed), dtype=F64)


def gaussians():
    unit = torch.nn.functional.normalize
    return {
        "means": random(COUNT, 3),
        "opacities": torch.sigmoid(random(COUNT, seed=1)),
        "times": NOW + 0.8 * random(COUNT, seed=2),
        "scales": torch.exp(0.4 * random(COUNT, 4, seed=3)) * 0.3,
        "rotations": (unit(random(COUNT, 4, seed=4)), unit(random(COUNT, 4, seed=5))),
    }


CONJUGATE = np.array([1, -1, -1, -1])


def multiplied(a, b):
    """Hamilton's product of quaternions w, x, y, z."""
    scalar = a[0] * b[0] - a[1:] @ b[1:]
    return np.array([scalar, *(a[0] * b[1:] + b[0] * a[1:] + np.cross(a[1:], b[1:]))])


def turned(left, right, point):
    """A point x, y, z, t turned by two quaternions, its coordinates read backwards as a third."""
    return multiplied(multiplied(left, point[::-1]), right * CONJUGATE)[::-1]


def covariance(g, row):
    """(4, 4) from the images of the axes."""
    left, right = (q[row].numpy() for q in g["rotations"])
    scales = g["scales"][row].tolist()
    axes = [s * turned(left, right, e) for s, e in zip(scales, np.eye(4), strict=True)]
    return sum(np.outer(axis, axis) for axis in axes)


def test_two_quaternions_turn_space_and_time():
    g = gaussians()
    for row, matrix in enumerate(slice4d.rotation_4d(*g["rotations"]).numpy()):
        left, right = (q[row].numpy() for q in g["rotations"])
        expected = np.stack([turned(left, right, axis) for axis in np.eye(4)], axis=1)
        np.testing.assert_allclose(matrix, expected, atol=1e-12)
        np.testing.assert_allclose(matrix @ matrix.T, np.eye(4), atol=1e-12)


@pytest.mark.parametrize("prefilter", [-1.0, 0.0, 0.02])
def test_a_moment_is_the_4d_density_at_that_time(prefilter):
    """By the precision matrix: no Schur complement, no division by the variance in time."""
    g = gaussians()
    moment = slice4d.joint(**g, timestamp=NOW, prefilter_var=prefilter)
    for row in range(COUNT):
        cov4d = covariance(g, row)
        precision = np.linalg.inv(cov4d)
        since = NOW - g["times"][row].item()
        # Where the exponent is least in space, at this time.
        shift = -np.linalg.solve(precision[:3, :3], precision[:3, 3] * since)
        at = np.append(shift, since)
        likely = math.exp(-0.5 * at @ precision @ at)
        if prefilter > 0:
            likely = math.exp(-0.5 * since**2 / (cov4d[3, 3] + prefilter))
        cov3d = np.linalg.inv(precision[:3, :3])[np.triu_indices(3)]
        np.testing.assert_allclose(moment.means[row], g["means"][row].numpy() + shift, atol=1e-10)
        np.testing.assert_allclose(moment.cov3d[row], cov3d, rtol=1e-8, atol=1e-12)
        expected = g["opacities"][row].item() * likely
        assert moment.opacities[row].item() == pytest.approx(expected, rel=1e-10)
        assert bool(moment.present[row]) == (likely > 0.05)


def test_some_are_there_and_some_are_not():
    present = slice4d.joint(**gaussians(), timestamp=NOW).present
    assert 0 < int(present.sum()) < COUNT


@pytest.mark.parametrize("prefilter", [-1.0, 0.02])
def test_gradients_of_a_moment_are_its_derivatives(prefilter):
    g = gaussians()
    leaves = [g["means"], g["opacities"], g["times"], g["scales"], *g["rotations"]]

    def outputs(means, opacities, times, scales, left, right):
        both = (left, right)
        m = slice4d.joint(
            means, opacities, times, scales, both, timestamp=NOW, prefilter_var=prefilter
        )
        return m.means, m.cov3d, m.opacities

    assert torch.autograd.gradcheck(outputs, [leaf.requires_grad_() for leaf in leaves])


def test_without_4d_rotation_gaussians_stay_where_they_are_and_only_their_strength_changes():
    """The temporal scale is a variance there, and the host's gradient leaves the marginal out."""
    g = gaussians()
    turns = g.pop("rotations")[0].requires_grad_()
    for name in g:
        g[name].requires_grad_()
    moment = slice4d.separate(**g, rotations=turns, timestamp=NOW)
    since, variance = NOW - g["times"], g["scales"][:, 3]
    marginal = np.exp(-0.5 * (since**2 / variance).detach().numpy())
    assert torch.equal(moment.means, g["means"])
    assert np.array_equal(moment.present.numpy(), marginal > 0.05)
    np.testing.assert_allclose(
        moment.opacities.detach(), g["opacities"].detach().numpy() * marginal, rtol=1e-12
    )
    for row in range(COUNT):  # a plain rotation of space: q v q*
        q = turns[row].detach().numpy()
        images = [multiplied(multiplied(q, np.append(0, e)), q * CONJUGATE) for e in np.eye(3)]
        axes = [image[1:] for image in images]
        scales = g["scales"][row, :3].detach().numpy()
        expected = sum(s**2 * np.outer(a, a) for s, a in zip(scales, axes, strict=True))
        np.testing.assert_allclose(
            moment.cov3d[row].detach(), expected[np.triu_indices(3)], rtol=1e-10, atol=1e-12
        )
    weights = random(COUNT, seed=9)
    (moment.opacities * weights).sum().backward()
    assert torch.equal(g["opacities"].grad, weights)
    assert not g["times"].grad.any()
    assert not g["scales"].grad.any()


@pytest.mark.parametrize("kind", ["joint", "separate", "still", "sliced"])
def test_a_slice_has_zeros_for_who_is_not_there_and_feels_nothing_of_them(kind):
    g = gaussians()
    g["times"][0] += 9
    turns, scales = g.pop("rotations"), g.pop("scales")
    given = {"scales": 2 * scales[:, :3], "rotations": turns[0]}
    if kind in ("joint", "separate"):
        given["scales_t"] = 2 * scales[:, 3]
    if kind == "joint":
        given["rotations_r"] = turns[1]
    if kind == "sliced":
        given = {"cov3d": slice4d.joint(**g, scales=scales, rotations=turns, timestamp=NOW).cov3d}
        given["cov3d"][3, 2] = math.inf
    leaves = {name: value.clone().requires_grad_() for name, value in (g | given).items()}
    splats = SpacetimeGaussians(**leaves, sh=SH, sh_degree=3)
    cut = slice_gaussians(splats, campos=CAMPOS, timestamp=NOW, scale_modifier=0.5)
    if kind in ("joint", "separate"):
        both = turns if kind == "joint" else turns[0]
        expected = getattr(slice4d, kind)(**g, scales=scales, rotations=both, timestamp=NOW)
        assert torch.equal(cut.present, expected.present)
        torch.testing.assert_close(cut.cov3d[cut.present], expected.cov3d[cut.present])
        torch.testing.assert_close(cut.opacities[cut.present], expected.opacities[cut.present])
    absent = ~cut.present
    assert absent.nonzero()[:1].flatten().tolist() == {"still": [], "sliced": [3]}.get(kind, [0])
    assert (cut.means[absent] == CAMPOS).all()
    for values in (cut.cov3d, cut.opacities, cut.colors):
        assert not values[absent].any()
    total = cut.means.sum() + cut.cov3d.sum() + cut.opacities.sum() + cut.colors.sum()
    total.backward()
    for leaf in leaves.values():
        assert leaf.grad is None or not leaf.grad[absent].any()


SH = random(COUNT, 48, 3, seed=6) * 0.4
MEANS, MOVED, CAMPOS = random(COUNT, 3, seed=7), random(COUNT, 3, seed=8), random(3, seed=10)
TIMES = 0.4 * random(COUNT, seed=11)


def painted(sh, means, degree, times=None, orders=0, duration=1.7):
    """(N, 3) before the clamp, from Legendre functions."""
    toward = torch.nn.functional.normalize(means - CAMPOS, dim=-1)
    bands = [(d, m) for d in range(degree + 1) for m in range(-d, d + 1)]
    table = torch.tensor(
        [[harmonic(d, m, v) for d, m in bands] for v in toward.tolist()], dtype=F64
    )
    total = 0.5
    for order in range(orders + 1):
        wave = 1.0 if not order else torch.cos(2 * math.pi * order * (times - NOW) / duration)
        blended = (table[:, :, None] * sh[:, 16 * order :][:, : len(bands)]).sum(dim=1)
        total = total + (blended if not order else wave[:, None] * blended)
    return total


@pytest.mark.parametrize("degree", range(4))
@pytest.mark.parametrize("orders", [None, 0, 1, 2])
def test_colours_are_harmonics_times_cosines_towards_the_means_as_stored(degree, orders):
    clock = None if orders is None else Clock(TIMES, NOW, 1.7, orders)
    ours = color4d.colors(SH, MEANS, MOVED, CAMPOS, degree, clock)
    used = orders if degree == 3 and orders else 0
    expected = painted(SH, MEANS, degree, TIMES, used).clamp_min(0)
    torch.testing.assert_close(ours, expected, rtol=1e-10, atol=1e-12)


def gradients(degree, orders):
    """Of colours that no clamp reaches, by sh, moved means and times."""
    leaves = [x.clone().requires_grad_() for x in (SH, MOVED, TIMES)]
    sh, moved, times = leaves
    clock = None if orders is None else Clock(times, NOW, 1.7, orders)
    lifted = sh + 50 * torch.eye(48, 1, dtype=F64)[None]
    weights = random(COUNT, 3, seed=12)
    colors = color4d.colors(lifted, MEANS, moved, CAMPOS, degree, clock)
    (colors * weights).sum().backward()
    return [leaf.grad for leaf in leaves], weights


def differences(function, at, step=1e-6):
    """Central differences of a scalar function, entry by entry."""
    flat = torch.zeros(at.numel(), dtype=F64)
    for i in range(at.numel()):
        change = torch.zeros(at.numel(), dtype=F64)
        change[i] = step
        change = change.reshape(at.shape)
        flat[i] = (function(at + change) - function(at - change)) / (2 * step)
    return flat.reshape(at.shape)


@pytest.mark.parametrize("orders", [None, 0, 1, 2])
def test_colours_have_the_hosts_gradients(orders):
    """Directions are those to the moved means; with time, three slips: see ``color4d``."""
    (by_sh, by_means, by_times), weights = gradients(3, orders)
    used, where = orders or 0, slice(0, 2)

    def total(sh, means, times):
        return (painted(sh, means, 3, times, used)[where] * weights[where]).sum()

    sh, means, times = SH[where], MOVED[where], TIMES[where]
    expected = differences(lambda x: total(x, means, times), sh)
    if orders is not None:
        expected[:, 1] = 0.28209479177387814 * weights[where]
    torch.testing.assert_close(by_sh[where], expected, rtol=1e-6, atol=1e-8)
    lifted = sh + 50 * torch.eye(48, 1, dtype=F64)[None]
    torch.testing.assert_close(
        by_means[where], differences(lambda x: total(lifted, x, times), means), rtol=1e-5, atol=1e-7
    )
    if used == 0:
        assert by_times is None or not by_times.any()
        return
    only = torch.zeros_like(sh)
    only[:, 16 * used :] = sh[:, 16 * used :]
    expected = -differences(lambda x: total(only, means, x), times)
    torch.testing.assert_close(by_times[where], expected, rtol=1e-6, atol=1e-8)


def test_a_clamped_channel_has_no_gradient():
    sh = (SH.clone() - 50 * torch.eye(48, 1, dtype=F64)[None]).requires_grad_()
    moved = MOVED.clone().requires_grad_()
    colors = color4d.colors(sh, MEANS, moved, CAMPOS, 3, Clock(TIMES, NOW, 1.7, 2))
    colors.sum().backward()
    assert not colors.any()
    assert not sh.grad.any()
    assert not moved.grad.any()
