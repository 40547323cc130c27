"""What a Gaussian is worth equals what loops over floats give; the best stay."""

from dataclasses import replace

import pytest
import scenes
import torch
from finetune import tiny
from oracle import naive

from fragprune_plugins import RasterInputs, ThresholdStore
from fragprune_plugins.engines import create_engine
from fragprune_plugins.errors import InputError
from fragprune_plugins.workbench import pruning as scores

COUNT = 20
VIEWS = [replace(c.view(), background=torch.tensor([0.2, 0.5, 0.9])) for c in tiny.cameras(3)]


def scene(truncated):
    model = tiny.random_model(COUNT, seed=3)
    model.opacity[:2] = -6.0  # faint: no fragment
    model.xyz[2] += 40  # in no picture
    stream = torch.Generator().manual_seed(1)
    thresholds = ThresholdStore.from_falloff(0.02 + 0.6 * torch.rand(COUNT, generator=stream))
    return replace(model, thresholds=thresholds if truncated else None)


def pixels(model):
    """For each pixel of each view: the fragments that are drawn, and the background."""
    for view in VIEWS:
        inputs = scenes.cast(RasterInputs(view, model.splats()), torch.float64)
        ordered = naive.splats_of(inputs, model.falloff)
        for y in range(view.height):
            for x in range(view.width):
                records = [r for r in naive.records_at(ordered, x, y)[0] if r.drawn]
                yield records, view.background.tolist()


def colour(fragments, background):
    """RGB of a pixel from (alpha, RGB) front to back."""
    light, out = 1.0, [0.0] * 3
    for alpha, rgb in fragments:
        out = [o + light * alpha * c for o, c in zip(out, rgb, strict=True)]
        light *= 1 - alpha
    return [o + light * b for o, b in zip(out, background, strict=True)]


@pytest.mark.parametrize("truncated", [False, True], ids=["whole", "truncated"])
def test_the_removal_error_is_estimated_without_bias(truncated):
    """Over many pixels the relative error is about sqrt(2 / times that a view is given)."""
    model = scene(truncated)
    truth = torch.zeros(COUNT)
    for records, background in pixels(model):
        pairs = [(r.alpha, r.color) for r in records]
        whole = colour(pairs, background)
        for k, record in enumerate(records):
            without = colour(pairs[:k] + pairs[k + 1 :], background)
            truth[record.row] += sum((a - b) ** 2 for a, b in zip(whole, without, strict=True))
    times = 400
    got = scores.removal_error(model, times * VIEWS, create_engine("auto")) / times
    spread = (2 / times) ** 0.5  # as if only one view counted
    assert ((got - truth).abs() <= 4 * spread * truth + 1e-9).all()
    assert (got[:3] == 0).all()


def test_the_removal_error_is_the_same_every_time():
    found = []
    for seed in (1, 2):
        torch.manual_seed(seed)
        found.append(scores.removal_error(scene(False), VIEWS, create_engine("auto")))
    assert torch.equal(*found)


@pytest.mark.parametrize(("share", "count"), [(1.0, 5), (0.6, 3), (0.5, 2), (0.01, 1)])
def test_the_best_are_as_many_as_asked_for_even_if_scores_are_equal(share, count):
    kept = scores.best(torch.tensor([0.0, 2.0, 0.0, 0.0, 1.0]), share)
    assert int(kept.sum()) == count
    assert kept[1]
    assert kept.tolist() == [count >= 3, True, count >= 4, count >= 5, count >= 2]


@pytest.mark.parametrize("share", [0.0, -0.1, 1.1, float("nan")])
def test_a_share_that_is_none_is_refused(share):
    with pytest.raises(InputError, match="share"):
        scores.best(torch.ones(3), share)


def test_thresholds_and_moments_stay_with_their_rows():
    model = scene(False)
    store = ThresholdStore(len(model))
    store.open(model.splats().opacities)
    store.logits.grad = torch.linspace(-1, 1, len(model))
    store.step(0.05)
    engine, model = create_engine("auto"), replace(model, thresholds=store)
    smaller = scores.keep_best(model, 0.5, VIEWS, engine=engine)
    kept = scores.best(scores.removal_error(model, VIEWS, engine), 0.5)
    assert len(smaller) == COUNT // 2
    expected = tiny.state(model.keep(kept))
    assert all(torch.equal(each, expected[k]) for k, each in tiny.state(smaller).items())


def test_what_can_be_spared_costs_no_more_than_its_share_of_the_error(model, dataset):
    shots, engine, splats = dataset.train, create_engine("auto"), model.splats()
    left = scores.keep_needed(model, shots, engine=engine)
    with torch.no_grad():
        pictures = [(engine.rasterize(RasterInputs(s.view, splats), None).image, s) for s in shots]
    error = sum(float((p.clamp(0, 1) - s.image).square().sum()) for p, s in pictures)
    each = scores.removal_error(model, [s.view for s in shots], engine)
    gone = torch.tensor([not (left.xyz == row).all(dim=1).any() for row in model.xyz])
    assert 0 < int(gone.sum()) == len(model) - len(left)
    spent = float(each[gone].sum())
    assert spent <= scores.SPARE * error < spent + float(each[~gone].min())
    assert each[gone].max() <= each[~gone].min()


def test_six_in_ten_stay_even_if_all_can_be_spared(truth, dataset, monkeypatch):
    monkeypatch.setattr(scores, "SPARE", 1e9)
    views = [shot.view for shot in dataset.train]
    worth = scores.removal_error(truth, views, create_engine("auto"))
    left = scores.keep_needed(truth, dataset.train)
    assert torch.equal(left.xyz, truth.xyz[scores.best(worth, 0.6)])


def test_the_budget_is_of_a_view_whichever_views_must_not_change(model, dataset):
    seen, views = dataset.train[:1], [shot.view for shot in dataset.train]
    engine = create_engine("auto")
    left = scores.keep_needed(model, seen, views, engine=engine)
    inputs = RasterInputs(seen[0].view, model.splats())
    with torch.no_grad():
        picture = engine.rasterize(inputs, None).image.clamp(0, 1)
    allowed = scores.SPARE * float((picture - seen[0].image).square().sum()) * len(views)
    each = scores.removal_error(model, views, engine)
    assert len(left) == len(model) - int((each.sort().values.cumsum(0) <= allowed).sum())
    assert len(left) != len(scores.keep_needed(model, seen, engine=engine))
