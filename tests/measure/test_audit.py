"""What a splat costs and what of it nobody sees, against pictures that were drawn without it."""

import math
from dataclasses import replace

import pytest
import torch
from finetune import tiny
from hypothesis import given, settings
from hypothesis import strategies as st

from fragprune_plugins import RasterInputs, engine_for
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
