"""Gaussians that reach no pixel go; no picture changes, to the bit."""

from dataclasses import replace

import pytest
import torch
from finetune import tiny
from hypothesis import given, settings
from hypothesis import strategies as st

from fragprune_plugins import rasterize
from fragprune_plugins.adapting import ALPHA_MIN, InputError, RasterInputs, Splats
from fragprune_plugins.engines import create_engine
from fragprune_plugins.workbench.pruning import visible

VIEWS = [camera.view() for camera in tiny.cameras()]


def logit(opacity):
    return torch.logit(torch.tensor(opacity)).item()


def with_strays(seed=0):
    """A model some of whose Gaussians are faint, out of every picture, or hidden by others."""
    model = tiny.random_model(seed=seed)
    xyz, opacity, scaling = model.xyz.clone(), model.opacity.clone(), model.scaling.clone()
    opacity[:10] = logit(0.003)  # faint
    xyz[10:20, 1] += 50  # out of the picture
    xyz[20:30] *= 0.01  # hidden: at the centre, tiny
    scaling[20:30] = -5.0
    scaling[30:50] = -0.5  # that hide
    opacity[30:50] = 8.0
    return replace(model, xyz=xyz, opacity=opacity, scaling=scaling)


def rows(splats: Splats, mask):
    names = ("means", "opacities", "scales", "rotations", "sh")
    return replace(splats, **{name: getattr(splats, name)[mask] for name in names})


@pytest.mark.parametrize("engine", ["cpu", "reference"])
@settings(max_examples=10, deadline=None)
@given(seed=st.integers(0, 10**6), truncated=st.booleans())
def test_no_picture_changes(engine, seed, truncated):
    model = with_strays(seed)
    stream = torch.Generator().manual_seed(seed)
    thresholds = torch.rand(len(model), generator=stream) ** 0.2 * 0.98 + 0.01
    thresholds = thresholds if truncated else None
    drawer, views = create_engine(engine), VIEWS if engine == "cpu" else VIEWS[::4]
    kept = visible(
        model if thresholds is None else tiny.cut(model, thresholds), views, engine=drawer
    )
    assert not kept[:20].any()
    splats = model.splats()
    for view in views:
        whole = drawer.rasterize(RasterInputs(view, splats, counts=True), thresholds)
        less = drawer.rasterize(
            RasterInputs(view, rows(splats, kept), counts=True),
            None if thresholds is None else thresholds[kept],
        )
        for name in ("image", "invdepth", "alpha", "fragments"):
            assert torch.equal(getattr(whole, name), getattr(less, name))
        drawn = whole.fragments_per_gaussian > 0
        assert not (drawn & ~kept).any()


def test_who_ends_a_pixel_without_being_drawn_there_stays():
    """A pixel stops before the Gaussian that would leave too little light."""
    plates, small, behind = [30.0] * 3, [0.1] * 3, [30.0] * 3
    model = replace(
        tiny.random_model(5),
        xyz=torch.tensor([[0, 0, -0.3], [0, 0, -0.2], [0, 0, -0.1], [0, 0, 0], [0, 0, 0.3]]),
        opacity=torch.logit(torch.tensor([0.95, 0.95, 0.95, 0.5, 0.1]))[:, None],
        scaling=torch.tensor([plates, plates, plates, small, behind]).log(),
    )
    thresholds = torch.tensor([0.01, 0.01, 0.01, 0.9, 0.01])

    def draw(kept):
        inputs = RasterInputs(VIEWS[0], model.keep(kept).splats(), counts=True)
        return rasterize(inputs, thresholds[kept])

    everybody = torch.ones(5, dtype=torch.bool)
    whole = draw(everybody)
    drawn = whole.fragments_per_gaussian > 0
    assert drawn.tolist() == [True, True, True, False, True]
    assert not torch.equal(draw(drawn).image, whole.image)
    assert torch.equal(visible(tiny.cut(model, thresholds), VIEWS[:1]), everybody)


def test_without_views_only_what_no_view_can_draw_goes():
    model = with_strays()
    kept = visible(model)
    assert (~kept).nonzero()[:, 0].tolist() == list(range(10))
    at_the_limit = replace(model, opacity=torch.full((len(model), 1), logit(ALPHA_MIN) + 1e-4))
    assert visible(at_the_limit).all()


def test_one_outside_one_view_stays_for_another():
    model = with_strays()
    both = visible(model, VIEWS)
    each = torch.stack([visible(model, [view]) for view in VIEWS])
    assert torch.equal(both, each.any(dim=0))


def test_views_of_something_else_are_refused():
    model = replace(tiny.random_model(), xyz=torch.full((60, 3), 900.0))
    with pytest.raises(InputError, match="none of 60 Gaussians"):
        visible(model, VIEWS)
