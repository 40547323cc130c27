"""Whether a splat is looked at from outside or from inside."""

import math

import pytest
import torch
from finetune import tiny

from fragprune_plugins import Model, engine_for
from fragprune_plugins.workbench.audit.placing import place

ENGINE = engine_for("auto", "cpu")


def box(count, half, seed=0):
    """Points on the six sides of a box."""
    stream = torch.Generator().manual_seed(seed)
    points = 2 * torch.rand(count, 3, generator=stream) - 1
    rows = torch.arange(count)
    points[rows, rows % 3] = points[rows, rows % 3].sign()
    return points * torch.tensor(half)


def room(seed=0):
    """Walls, a ceiling, a floor, and a table in a corner."""
    table = box(400, (0.6, 0.4, 0.6), seed) + torch.tensor([1.5, 1.0, -1.0])
    return tiny.round_ones(torch.cat([box(4000, (3.0, 1.5, 2.5), seed), table]), 0.12)


def thing(seed=0):
    """A solid object on a round plate."""
    stream = torch.Generator().manual_seed(seed)
    body = torch.randn(2500, 3, generator=stream)
    body *= (torch.rand(2500, 1, generator=stream) ** (1 / 3)) / body.norm(dim=1, keepdim=True)
    turn, reach = 2 * math.pi * torch.rand(1500, generator=stream), 2.0
    radius = reach * torch.rand(1500, generator=stream).sqrt()
    plate = torch.stack([radius * turn.cos(), torch.full((1500,), 1.0), radius * turn.sin()], 1)
    return tiny.round_ones(torch.cat([body, plate]), 0.1)


@pytest.mark.parametrize("seed", range(3))
def test_a_room_is_looked_at_from_inside(seed):
    model = room(seed)
    placed = place(model, 8, ENGINE)
    assert placed.side == "inside"
    assert placed.enclosed > 0.6
    assert f"{placed.enclosed:.0%} of all directions" in placed.why
    for _, view in placed.views:
        assert (view.campos.abs() < torch.tensor([3.0, 1.5, 2.5])).all()


@pytest.mark.parametrize("side", [-1, 1])
def test_what_is_shown_first_is_the_front_and_from_above(side):
    """A board, painted on one side and plain on the other; y is down."""
    across = torch.linspace(-1, 1, 40)
    board = torch.cartesian_prod(torch.tensor([-0.3, 0.3]), across, across)
    model = tiny.round_ones(board, 0.04)
    squares = ((board[:, 1:] * 4).floor().sum(dim=1) % 2)[:, None, None].expand(-1, 1, 3)
    model.f_dc[:] = torch.where(board[:, :1, None] * side > 0, 3 * squares - 1.5, 0.0)
    views = [view for _, view in place(model, 12, ENGINE, side="orbit", divide=10).views]
    assert side * float(views[0].campos[0]) > 0
    assert [bool(view.campos[1] < 0) for view in views] == 6 * [True] + 6 * [False]


@pytest.mark.parametrize("seed", range(3))
def test_an_object_is_looked_at_from_outside(seed):
    placed = place(thing(seed), 8, ENGINE)
    assert placed.side == "orbit"
    assert placed.enclosed < 0.5
    for _, view in placed.views:
        assert view.campos.norm() > 2


def test_nobody_looks_out_of_the_open_side():
    whole = room()
    model = whole.keep(whole.xyz[:, 0] < 2.9)
    placed = place(model, 6, ENGINE, side="inside", divide=10)
    for _, view in placed.views:
        ahead = view.viewmatrix[:3, 2]
        assert float(ahead[0]) < 0.8
    assert len(placed.views) == 6


def test_thin_haze_all_around_is_no_air():
    """Large faint Gaussians before every wall: no place is open, so cameras stay outside."""
    walls, stream = room(), torch.Generator().manual_seed(1)
    haze = tiny.round_ones(0.2 * torch.randn(60, 3, generator=stream), 1.0, 0.3)
    both = {name: torch.cat([each, haze.tensors[name]]) for name, each in walls.tensors.items()}
    assert place(Model(**both), 4, ENGINE).enclosed < place(walls, 4, ENGINE).enclosed


@pytest.mark.parametrize(("model", "side"), [(room, "orbit"), (thing, "inside")])
def test_it_can_be_asked_for(model, side):
    placed = place(model(), 5, ENGINE, side=side, divide=4)
    assert placed.side == side
    assert placed.why == "As asked for."
    assert {(view.width, view.height) for _, view in placed.views} == {(200, 200)}
    assert len(placed.views) == 5


def test_the_same_model_is_looked_at_from_the_same_places():
    one, other = (place(room(), 6, ENGINE).views for _ in range(2))
    for (_, view), (_, again) in zip(one, other, strict=True):
        assert torch.equal(view.viewmatrix, again.viewmatrix)
