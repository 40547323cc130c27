"""Scores: one number for each Gaussian, the larger the more it is worth to the pictures.

A score is a function of the N Gaussians, their thresholds, the views and an engine; ``SCORES`` has
them all by name. Views are drawn by vanilla's rules. ``best`` chooses the Gaussians to keep.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import replace

import torch
from torch import Tensor
from tqdm import tqdm

from fragprune_plugins.engines import Engine
from fragprune_plugins.engines.reference import fragments
from fragprune_plugins.errors import InputError
from fragprune_plugins.files.model import Model
from fragprune_plugins.plugins.hooks import engine_for
from fragprune_plugins.types import RasterInputs, RasterOutputs, View
from fragprune_plugins.workbench.scenes.dataset import Shot

Score = Callable[[Model, Tensor | None, Iterable[View], Engine], Tensor]
"""Gives (N,) from N Gaussians, their thresholds (N,) in falloff or None, views, and an engine."""

VOLUME_POWER = 0.1
"""LightGaussian's exponent of a Gaussian's volume (``v_pow``)."""

PROBES = 4
"""Random passes over a view in ``removal_error``."""

SPARE = 0.002
"""Share of the squared error up to which ``keep_needed`` removes.

Errors of neighbours add up, so it rises by three to eight times as much: 0.02 to 0.07 dB on three
scenes for 11 % to 17 % of the Gaussians. Learning makes up for that.
"""

GAUSSIAN_PRICE = 30.0
"""Fragments that a Gaussian itself costs in a frame: its projection and its places in lists.

On the cpu engine 21 to 94, by the stages of six frames of three scenes, 90x160 to 1024x1024 pixels.
"""


def keep_best(
    model: Model,
    share: float,
    views: Sequence[View],
    *,
    score: Score | None = None,
    engine: str | Engine = "auto",
    progress: bool = False,
) -> Model:
    """Copy a model without the Gaussians of the lowest score. Thresholds keep their moments.

    Args:
        model: N Gaussians and their thresholds.
        share: of the Gaussians to keep, in (0, 1]; at least one is kept.
        views: to score them on, on the model's device.
        score: gives the numbers; ``removal_error`` when None.
        engine: a name or an engine.
        progress: draw a bar on stderr.

    Raises:
        InputError: the share is not in (0, 1].
    """
    score = removal_error if score is None else score
    drawer = _drawer(engine, model)
    scores = score(model, model.falloff, _bar(views, progress), drawer)
    return model.keep(best(scores, share))


def keep_needed(
    model: Model,
    shots: Sequence[Shot],
    *,
    engine: str | Engine = "auto",
    progress: bool = False,
) -> Model:
    """Copy a model without the Gaussians that its photographs can spare.

    Those of the least ``removal_error`` go, until these errors add up to ``SPARE`` of the squared
    error of the whole model. Thresholds keep their moments.

    Args:
        model: N Gaussians and their thresholds.
        shots: the photographs to learn from, on the model's device.
        engine: a name or an engine.
        progress: draw a bar on stderr.
    """
    thresholds = model.falloff
    drawer, splats, error = _drawer(engine, model), model.splats(), 0.0
    with torch.no_grad():
        for shot in shots:
            inputs = RasterInputs(shot.view, splats, planes=(), **model.rules)
            image = drawer.rasterize(inputs, thresholds).image
            error += float((shot.looked_at(image).clamp(0, 1) - shot.image).square().sum())
    views = _bar([shot.view for shot in shots], progress)
    each, least = removal_error(model, thresholds, views, drawer).double().sort(stable=True)
    spared = int((each.cumsum(0) <= SPARE * error).sum())
    kept = torch.ones_like(each, dtype=torch.bool)
    kept[least[: min(spared, len(each) - 1)]] = False
    return model.keep(kept)


def best(scores: Tensor, share: float) -> Tensor:
    """(N,) bool: the share of the Gaussians that has the largest scores (N,), rounded to a number.

    Of equal scores the first rows stay, so that as many are kept as were asked for.

    Raises:
        InputError: the share is not in (0, 1].
    """
    if not 0 < share <= 1:
        raise InputError("share", f"{share:g}", "0 < X <= 1", "Choose one, such as 0.6.")
    count = max(1, round(share * len(scores)))
    kept = torch.zeros_like(scores, dtype=torch.bool)
    kept[scores.argsort(descending=True, stable=True)[:count]] = True
    return kept


@torch.no_grad()
def opacity(
    model: Model, thresholds: Tensor | None, views: Iterable[View], engine: Engine
) -> Tensor:
    """The opacity, by which 3DGS itself prunes."""
    return model.splats().opacities


def total_weight(
    model: Model, thresholds: Tensor | None, views: Iterable[View], engine: Engine
) -> Tensor:
    """Sum of the weights alpha T of all fragments: the light that it gives to all views.

    The score of LP-3DGS (``bw_score``) and, for Gaussians that win a pixel, of Mini-Splatting
    indoors (``imp_metric``).
    """
    return _summed(model, thresholds, views, engine, lambda drawn: drawn.weights_per_gaussian)


def largest_weight(
    model: Model, thresholds: Tensor | None, views: Iterable[View], engine: Engine
) -> Tensor:
    """The largest weight alpha T of any fragment in any view (RadSplat 2024; LP-3DGS ``mw_score``).

    No engine gives it: it reads every fragment from the reference engine, seconds for a small view.
    """
    scores = model.opacity.new_zeros(len(model))
    for inputs in _inputs(model, views):
        for tile in fragments(inputs, thresholds):
            largest = tile.weights.amax(dim=1)
            scores[tile.rows] = scores[tile.rows].maximum(largest)
    return scores


def light_gaussian(
    model: Model, thresholds: Tensor | None, views: Iterable[View], engine: Engine
) -> Tensor:
    """Opacity x fragments x volume^0.1: LightGaussian's score (2023), up to a common factor.

    As its code has it (``calculate_v_imp_score``; its rasterizer adds an opacity for each fragment
    that is blended). The paper multiplies each fragment by its transmittance, too.
    """
    splats = model.splats()
    assert splats.scales is not None
    volume = splats.scales.detach().prod(dim=1)
    hits = _summed(model, thresholds, views, engine, lambda drawn: drawn.fragments_per_gaussian)
    return splats.opacities.detach() * hits * volume**VOLUME_POWER


def mini_splatting(
    model: Model, thresholds: Tensor | None, views: Iterable[View], engine: Engine
) -> Tensor:
    """Sum over views of the mean weight of its fragments, where it wins a pixel of the view.

    Mini-Splatting's importance outdoors (2024, ``imp_metric``): 0 for who never has the largest
    weight of a pixel. It then keeps a random sample, weighted by this; ``best`` keeps the largest.
    """

    def mean_weight(drawn: RasterOutputs) -> Tensor:
        weights, counts = drawn.weights_per_gaussian, drawn.fragments_per_gaussian
        assert weights is not None
        assert counts is not None
        assert drawn.wins_per_gaussian is not None
        return torch.where(drawn.wins_per_gaussian > 0, weights / counts.clamp(min=1), 0.0)

    return _summed(model, thresholds, views, engine, mean_weight)


def falloff_gradient(
    model: Model, thresholds: Tensor | None, views: Iterable[View], engine: Engine
) -> Tensor:
    """Sum over fragments of the squared gradient by the falloff: Speedy-Splat's score (2024).

    The gradient is that of the sum of the pixel's three channels (``score_func``). No engine gives
    it: it reads every fragment from the reference engine, seconds for a small view.
    """
    scores = model.opacity.new_zeros(len(model))
    for inputs in _inputs(model, views):
        background = inputs.view.background.sum()
        for tile in fragments(inputs, thresholds):
            light, color = tile.light, tile.color.sum(dim=1)[:, None]
            given = tile.alpha * light * color
            behind = given.sum(dim=0) - given.cumsum(dim=0)
            behind += background * (1 - tile.alpha).prod(dim=0)
            slope = tile.opacity[:, None] * (light * color - behind / (1 - tile.alpha))
            squared = slope.square() * tile.drawn
            scores.index_add_(0, tile.rows, squared.sum(dim=1))
    return scores


def removal_error(
    model: Model, thresholds: Tensor | None, views: Iterable[View], engine: Engine
) -> Tensor:
    """Squared change of all pictures if this Gaussian alone went, estimated; the same every time.

    A pixel is linear in a fragment's alpha, so its change is alpha times the gradient by alpha.
    The sum of squares over pixels is the mean square of gradients by the opacity of pictures
    whose values have random signs (Hutchinson's estimator): a few backward passes a view, on any
    engine. A pixel's stop at little transmittance is left out.
    """
    splats = model.splats()
    opacities = splats.opacities.detach().clone().requires_grad_(True)
    splats = replace(splats, opacities=opacities)
    stream = torch.Generator().manual_seed(0)
    scores = torch.zeros_like(opacities)
    for view in views:
        inputs = RasterInputs(view, splats, planes=(), **model.rules)
        image = engine.rasterize(inputs, thresholds).image
        for probe in range(PROBES):
            signs = torch.randint(0, 2, image.shape, generator=stream).mul(2).sub(1).to(image)
            (slope,) = torch.autograd.grad(image, opacities, signs, retain_graph=probe < PROBES - 1)
            scores += (opacities.detach() * slope).square()
    return scores.detach() / PROBES


def removal_error_per_price(
    model: Model, thresholds: Tensor | None, views: Iterable[View], engine: Engine
) -> Tensor:
    """``removal_error`` over ``price``: what it gives for what it costs."""
    views = list(views)
    worth = removal_error(model, thresholds, views, engine)
    return worth / price(model, thresholds, views, engine)


def price(model: Model, thresholds: Tensor | None, views: Iterable[View], engine: Engine) -> Tensor:
    """What a Gaussian costs in a frame, in fragments: those drawn, mean over views, and its own."""
    views = list(views)
    drawn = _summed(model, thresholds, views, engine, lambda drawn: drawn.fragments_per_gaussian)
    return drawn / len(views) + GAUSSIAN_PRICE


def _drawer(engine: str | Engine, model: Model) -> Engine:
    return engine_for(engine, model.device) if isinstance(engine, str) else engine


def _bar(views: Sequence[View], progress: bool) -> Iterable[View]:
    """The views, with a bar that shows how far they have been scored."""

    bar: Iterable[View] = tqdm(
        views, "scoring Gaussians", unit="view", leave=None, disable=not progress
    )
    return bar


SCORES: dict[str, Score] = {
    "removal-error": removal_error,
    "removal-error-per-price": removal_error_per_price,
    "opacity": opacity,
    "total-weight": total_weight,
    "largest-weight": largest_weight,
    "light-gaussian": light_gaussian,
    "mini-splatting": mini_splatting,
    "falloff-gradient": falloff_gradient,
}
"""Every score by its name."""


def _inputs(model: Model, views: Iterable[View]) -> Iterator[RasterInputs]:
    """The inputs of every view, with counts and weights."""
    splats = model.splats()
    for view in views:
        yield RasterInputs(view, splats, planes=(), counts=True, scores=True, **model.rules)


@torch.no_grad()
def _summed(
    model: Model,
    thresholds: Tensor | None,
    views: Iterable[View],
    engine: Engine,
    figure: Callable[[RasterOutputs], Tensor | None],
) -> Tensor:
    """(N,) sum over views of a figure (N,)."""
    scores = model.opacity.new_zeros(len(model))
    for inputs in _inputs(model, views):
        each = figure(engine.rasterize(inputs, thresholds))
        assert each is not None
        scores += each
    return scores
