"""What a splat costs and what of it nobody sees, from where it is seen, and in other viewers."""

import math
from dataclasses import replace

import pytest
import torch
from finetune import tiny
from hypothesis import given, settings
from hypothesis import strategies as st

from fragprune_plugins import Model, RasterInputs, engine_for, look_at
from fragprune_plugins.engines.fragments import fragments
from fragprune_plugins.engines.reference import ReferenceEngine
from fragprune_plugins.workbench.audit.audit import (
    AS_IT_IS,
    HALF_LEVEL,
    HONOURING,
    REASONS,
    UNTRUNCATED,
    Idle,
    audit,
    weigh,
)
from fragprune_plugins.workbench.audit.placing import place
from fragprune_plugins.workbench.figures.extents import CUTS, SQRT8, VIEWERS, Extent, Viewer, shaded
from reference_renderer.render import Blended

ENGINE = engine_for("auto", "cpu")
SIZES = ((24, 32), (60, 40))


def column(seed, count):
    """The fragments of 16 pixels, as the reference engine gives them, in float64."""
    stream = torch.Generator().manual_seed(seed)

    def uniform(*shape):
        return torch.rand(*shape, generator=stream, dtype=torch.float64)

    drawn = uniform(count, 16) < 0.7
    alpha = uniform(count, 16).pow(4).clamp(1 / 255, 0.99) * drawn
    opacity, color = uniform(count).clamp(min=0.02), 1.3 * uniform(count, 3)
    return Blended(torch.arange(count), alpha, drawn, opacity, color)


def composed(tile, kept, background):
    """(3, P) the colours of the pixels of those fragments alone, blended one after another."""
    colour = torch.zeros(3, tile.alpha.shape[1], dtype=torch.float64)
    left = torch.ones(tile.alpha.shape[1], dtype=torch.float64)
    for alpha, keep, each in zip(tile.alpha, kept, tile.color, strict=True):
        alpha = alpha * keep
        colour += each[:, None] * alpha * left
        left = left * (1 - alpha)
    return colour + background[:, None] * left


@settings(max_examples=30)
@given(st.integers(0, 1000), st.integers(1, 20))
def test_idle_fragments_can_go_alone_and_together(seed, count):
    tile, background = column(seed, count), torch.tensor([0.1, 0.9, 0.4], dtype=torch.float64)
    alone, together, _ = weigh(tile, background)
    whole = composed(tile, tile.drawn, background)
    for row in range(count):
        kept = tile.drawn.clone()
        kept[row] = False
        moved = (composed(tile, kept, background) - whole).abs().amax(dim=0)
        unclear = (moved - HALF_LEVEL).abs() < 1e-9
        expected = tile.drawn[row] & (moved < HALF_LEVEL)
        assert torch.equal(alone[row] | unclear, expected | unclear)
    rest = composed(tile, tile.drawn & ~together, background)
    assert float((rest - whole).abs().max()) <= HALF_LEVEL + 1e-12
    assert not (together & ~tile.drawn).any()


@settings(max_examples=20)
@given(st.integers(0, 1000))
def test_together_are_as_many_as_the_bound_allows(seed):
    tile, background = column(seed, 20), torch.zeros(3, dtype=torch.float64)
    _, together, _ = weigh(tile, background)
    reach = float(tile.color.max())
    for pixel in range(16):
        weights = (tile.alpha * tile.light)[tile.drawn[:, pixel], pixel].sort().values.tolist()
        spent, most = 0.0, 0
        while most < len(weights) and spent + reach * weights[most] <= HALF_LEVEL:
            spent += reach * weights[most]
            most += 1
        assert int(together[:, pixel].sum()) == most


def test_alone_is_what_pictures_without_one_gaussian_show():
    model, view, engine = tiny.random_model(20), tiny.cameras()[0].view(), ReferenceEngine()
    # Without pixels that end, for the light behind them would be a third picture's.
    splats = replace(model.splats(), opacities=0.3 * model.splats().opacities)
    inputs = RasterInputs(view, splats)
    idle = Idle()
    for tile in fragments(inputs, None):
        idle.add(tile, view.background)
    whole = engine.rasterize(replace(inputs, counts=True), None)
    expected = unclear = 0
    nothing = torch.full_like(splats.opacities, 1e-6)

    def drawn(opacities):
        changed = replace(splats, opacities=opacities)
        return engine.rasterize(replace(inputs, splats=changed, counts=True), None)

    for row in range(len(splats)):
        one = torch.arange(len(splats)) == row
        there = drawn(torch.where(one, splats.opacities, nothing)).fragments
        without = drawn(torch.where(one, nothing, splats.opacities)).image
        moved = (without - whole.image).abs().amax(dim=0)[there > 0]
        expected += int((moved < HALF_LEVEL).sum())
        unclear += int(((moved - HALF_LEVEL).abs() < 1e-6).sum())
    drawn = idle.as_dict()["fragments"]
    assert drawn == int(whole.fragments.sum())
    assert abs(idle.alone - expected) <= unclear
    assert 0 < idle.alone < drawn


@pytest.fixture(scope="module")
def figures():
    views = [("the same", camera.view()) for camera in tiny.cameras(4)]
    found, shown = audit(tiny.random_model(), views, engine=ENGINE, repeats=1)
    return found, shown


def test_reasons_share_out_all_fragments(figures):
    idle = figures[0]["idle"]
    assert idle["together"] <= idle["alone"] <= 1
    assert [each["name"] for each in idle["reasons"]] == list(REASONS)
    for all_of, named in (("share", 1.0), ("idle", idle["together"])):
        assert sum(each[all_of] for each in idle["reasons"]) == pytest.approx(named)
    assert idle["pixels"] == 4 * tiny.SIDE**2  # of so small views no tile is left out
    per_pixel = idle["fragments"] / idle["pixels"]
    assert per_pixel == pytest.approx(figures[0]["fragments_per_pixel"])


def test_cuts_are_compared_with_the_model_as_it_is(figures):
    found, shown = figures
    first, *cuts = found["cuts"]
    assert (first["name"], first["psnr"], first["worst_psnr"]) == (AS_IT_IS, math.inf, math.inf)
    for cut in cuts:
        assert cut["fragments_per_pixel"] < first["fragments_per_pixel"]
        assert cut["worst_psnr"] <= cut["psnr"] < 100
    by_alpha = [cut["psnr"] for cut in cuts if cut["name"].startswith("alpha")]
    assert by_alpha == sorted(by_alpha, reverse=True)
    assert len({float(view.image.sum()) for view in shown}) == len(shown) == 3
    for view in shown:
        assert view.fragments.shape == view.overdraw.shape == view.image.shape[1:]
    assert HONOURING not in [each["viewers"] for each in found["viewers"]]


def test_a_stop_is_priced_on_a_model_without_one_and_is_its_own_on_another():
    splat, views = tiny.random_model(), [("view", tiny.cameras()[0].view())]
    plain, _ = audit(splat, views, engine=ENGINE, repeats=1)
    priced = plain["cuts"][-1]
    stopped, _ = audit(splat.with_rules(stop=0.02), views, engine=ENGINE, repeats=1)
    assert (plain["stop"], stopped["stop"]) == (None, 0.02)
    assert priced["name"] == "a stop at 0.02"
    assert priced["fragments_per_pixel"] == stopped["fragments_per_pixel"]
    assert stopped["cuts"][-1]["name"] == UNTRUNCATED
    assert stopped["cuts"][-1]["fragments_per_pixel"] == plain["fragments_per_pixel"]
    pays = [each["shaded_per_pixel"] for each in stopped["viewers"]]
    assert pays == [each["shaded_per_pixel"] for each in plain["viewers"]]  # quads cannot stop


def test_a_pruned_model_is_measured_with_its_thresholds_and_without():
    splat = tiny.random_model()
    pruned = tiny.cut(splat, 0.3)
    views = [("view", tiny.cameras()[0].view())]
    found, _ = audit(pruned, views, engine=ENGINE, repeats=1)
    plain, _ = audit(splat, views, engine=ENGINE, repeats=1)
    last = found["cuts"][-1]
    assert last["name"] == UNTRUNCATED
    assert last["fragments_per_pixel"] == plain["fragments_per_pixel"]
    assert found["fragments_per_pixel"] < plain["fragments_per_pixel"]
    assert found["cuts"][-2]["fragments_per_pixel"] <= found["fragments_per_pixel"]
    pays = {each["viewers"]: each["shaded_per_pixel"] for each in found["viewers"]}
    others = {each["viewers"]: each["shaded_per_pixel"] for each in plain["viewers"]}
    assert pays.pop(HONOURING) < min(pays["PlayCanvas"], pays[found["viewers"][0]["viewers"]])
    assert pays == others  # who knows no thresholds pays as before


def test_the_size_of_the_timed_frames_is_said_smallest_and_largest():
    small, large = (replace(tiny.cameras(1)[0].view(), width=w, height=h) for w, h in SIZES)
    for views, size in (((large, small), "24x32 to 60x40"), ((large,), "60x40")):
        named = [(str(number), view) for number, view in enumerate(views)]
        figures, _ = audit(tiny.random_model(5), named, engine=ENGINE, tiles=1, repeats=1)
        assert figures["frame_size"] == size


BY_NAME = {viewer.names.split(",")[0]: viewer for viewer in VIEWERS}


def one(opacity=0.5, size=0.2):
    """A round Gaussian in the middle of the picture, and its variance there, pixels^2."""
    splat = tiny.round_ones(torch.zeros(1, 3), size, opacity)
    view = look_at((0, 0, -4), (0, 0, 0), width=160, height=160, fov_y=53.13)
    focal = 160 / (2 * view.tan_fov_y)
    return RasterInputs(view, splat.splats()), (focal * size / 4) ** 2 + 0.3


@pytest.mark.parametrize(
    ("viewer", "opacity", "squared"),
    [
        *(("antimatter15/splat", opacity, 8.0) for opacity in (0.5, 0.02)),  # however faint
        ("three.js GaussianSplatMesh", 0.02, 4.0),
        *(("PlayCanvas", 0.5, 8.0), ("PlayCanvas", 0.002, 0.0)),
        ("PlayCanvas", 0.05, 2 * math.log(255 * 0.05)),
    ],
)
def test_a_quad_around_one_gaussian(viewer, opacity, squared):
    inputs, variance = one(opacity)
    pixels = shaded(ReferenceEngine(), inputs, BY_NAME[viewer]) * 160 * 160
    side = 2 * math.sqrt(squared * variance)
    assert pixels == pytest.approx(side**2, rel=0.03, abs=2)  # an ellipse's pixels are counted


def test_tiles_of_the_host_are_those_of_the_oracle():
    splats = tiny.random_model(count=200).splats()
    view = look_at((0, 0, -2.5), (0, 0, 0), width=96, height=64)
    inputs = RasterInputs(view, splats, planes=())
    out = ReferenceEngine().rasterize(inputs, None)
    host = BY_NAME["3DGS reference (CUDA)"]
    assert shaded(ReferenceEngine(), inputs, host) == pytest.approx(out.evaluated_per_pixel)


def test_tiles_of_a_box_that_follows_the_opacity():
    inputs, variance = one(0.05, size=0.3)
    half = math.ceil(math.sqrt(2 * math.log(255 * 0.05) * variance))
    first, last = math.floor((79.5 - half) / 16), math.ceil((79.5 + half) / 16)
    expected = (last - first) ** 2 * 256 / 160**2
    assert shaded(ReferenceEngine(), inputs, BY_NAME["gsplat 1.5"]) == pytest.approx(expected)


@pytest.mark.parametrize("extent", [*CUTS, SQRT8], ids=lambda extent: extent.name)
def test_thresholds_end_where_the_rule_does(extent):
    opacities = torch.tensor([0.004, 0.02, 0.3, 0.9], dtype=torch.float64)
    thresholds = extent.thresholds(opacities)
    assert ((thresholds > 0) & (thresholds <= 1)).all()
    kept = extent.squared(opacities) >= 0
    at_rim = thresholds[kept]
    assert torch.allclose(-2 * at_rim.log(), extent.squared(opacities)[kept])
    if extent.alpha:
        assert (at_rim * opacities[kept] >= extent.alpha * (1 - 1e-9)).all()


def test_a_smaller_extent_never_shades_more():
    inputs = RasterInputs(tiny.cameras()[0].view(), tiny.random_model().splats())
    for shape in ("quad", "square", "box"):
        pixels = [
            shaded(ReferenceEngine(), inputs, Viewer("", Extent("", sigmas), shape))
            for sigmas in (1.0, 2.0, math.sqrt(8), 3.0)
        ]
        assert pixels == sorted(pixels)
        assert pixels[0] < pixels[-1]


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
