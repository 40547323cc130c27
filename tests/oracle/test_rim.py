"""A soft rim: how much of a pixel it covers, and the derivatives of that."""

import math
from dataclasses import replace

import pytest
import scenes
import torch

from fragprune_plugins import rasterize

F64 = torch.float64
SIZE = 33


def draw(inputs, tau):
    return rasterize(
        replace(inputs, counts=True), torch.tensor([tau], dtype=F64), engine="reference"
    )


def ellipse(sigma, **kind):
    """One splat, larger than its truncated ellipse by far, between pixels."""
    return scenes.one_splat(
        (16.3, 15.6), sigma=sigma, opacity=0.9, width=SIZE, height=SIZE, dtype=F64, **kind
    )


@pytest.mark.parametrize("sigma", [(14.0, 14.0), (20.0, 9.0)], ids=["circle", "ellipse"])
def test_a_pixel_gets_the_share_that_many_samples_of_a_hard_rim_get(sigma):
    inputs, n, tau = ellipse(sigma), 8, 0.8
    places = (torch.arange(n, dtype=F64) + 0.5) / n - 0.5
    total = torch.zeros(SIZE, SIZE, dtype=F64)
    for x in places:
        for y in places:
            offsets = torch.stack([x, y]).expand(SIZE, SIZE, 2)
            total += draw(replace(inputs, sample_offsets=offsets), tau).alpha[0]
    hard, soft = draw(inputs, tau).alpha[0], draw(replace(inputs, rim="soft"), tau).alpha[0]
    expected = total / n**2
    assert (hard - expected).abs().max() > 0.3  # aliased
    assert (soft - expected).abs().max() < 0.06


def test_a_fragment_is_drawn_where_any_of_its_pixel_is_covered():
    inputs, tau = ellipse((9.0, 9.0)), 0.8
    hard, soft = draw(inputs, tau), draw(replace(inputs, rim="soft"), tau)
    spread = math.sqrt(81.3)
    rim = spread * math.sqrt(-2 * math.log(tau))
    away = torch.cartesian_prod(torch.arange(SIZE), torch.arange(SIZE)).double()
    away = (away - torch.tensor([15.6, 16.3], dtype=F64)).norm(dim=1).reshape(SIZE, SIZE)
    assert torch.equal(hard.fragments > 0, away <= rim)
    # to first order the rim lies at (rim^2 + away^2) / (2 away)
    assert torch.equal(soft.fragments > 0, (rim**2 + away**2) / (2 * away) > away - 0.5)
    within = away < rim - 1
    assert torch.equal(soft.alpha[0][within], hard.alpha[0][within])


def test_the_counts_gradient_is_that_of_the_covered_area():
    inputs, spread, tau = replace(ellipse((9.0, 9.0)), rim="soft"), 81.3, 0.8
    given = torch.tensor([tau], dtype=F64, requires_grad=True)
    rasterize(inputs, given, engine="reference").fragments_per_pixel.backward()
    area_by_tau = -2 * math.pi * spread / tau  # of pi spread (-2 ln tau)
    assert given.grad.item() * SIZE**2 == pytest.approx(area_by_tau, rel=0.03)
