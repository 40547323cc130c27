"""Scores of Gaussians from the literature, beside our own; views are drawn by vanilla's rules."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator

import torch
from torch import Tensor

from fragprune_plugins.engines import Engine
from fragprune_plugins.engines.fragments import fragments
from fragprune_plugins.files.model import Model
from fragprune_plugins.types import RasterInputs, RasterOutputs, View
from fragprune_plugins.workbench.pruning import removal_error

Score = Callable[[Model, Iterable[View], Engine], Tensor]
"""Gives (N,) from N Gaussians, with their thresholds if they have any, views, and an engine.

The larger the number, the more the Gaussian is worth.
"""

VOLUME_POWER = 0.1
"""LightGaussian's exponent of a Gaussian's volume (``v_pow``)."""


@torch.no_grad()
def opacity(model: Model, views: Iterable[View], engine: Engine) -> Tensor:
    """The opacity, by which 3DGS itself prunes."""
    return model.splats().opacities


def total_weight(model: Model, views: Iterable[View], engine: Engine) -> Tensor:
    """Sum of the weights alpha T of all fragments: the light that it gives to all views.

    The score of LP-3DGS (``bw_score``) and, for Gaussians that win a pixel, of Mini-Splatting
    indoors (``imp_metric``).
    """
    return _summed(model, views, engine, lambda drawn: drawn.weights_per_gaussian)


def largest_weight(model: Model, views: Iterable[View], engine: Engine) -> Tensor:
    """The largest weight alpha T of any fragment in any view (RadSplat 2024; LP-3DGS ``mw_score``).

    No engine gives it: it reads every fragment from the reference engine, seconds for a small view.
    """
    scores = model.opacity.new_zeros(len(model))
    for inputs in _inputs(model, views):
        for tile in fragments(inputs, model.falloff):
            largest = tile.weights.amax(dim=1)
            scores[tile.rows] = scores[tile.rows].maximum(largest)
    return scores


def light_gaussian(model: Model, views: Iterable[View], engine: Engine) -> Tensor:
    """Opacity x fragments x volume^0.1: LightGaussian's score (2023), up to a common factor.

    As its code has it (``calculate_v_imp_score``; its rasterizer adds an opacity for each fragment
    that is blended). The paper multiplies each fragment by its transmittance, too.
    """
    splats = model.splats()
    assert splats.scales is not None
    volume = splats.scales.detach().prod(dim=1)
    hits = _summed(model, views, engine, lambda drawn: drawn.fragments_per_gaussian)
    return splats.opacities.detach() * hits * volume**VOLUME_POWER


def mini_splatting(model: Model, views: Iterable[View], engine: Engine) -> Tensor:
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

    return _summed(model, views, engine, mean_weight)


def falloff_gradient(model: Model, views: Iterable[View], engine: Engine) -> Tensor:
    """Sum over fragments of the squared gradient by the falloff: Speedy-Splat's score (2024).

    The gradient is that of the sum of the pixel's three channels (``score_func``). No engine gives
    it: it reads every fragment from the reference engine, seconds for a small view.
    """
    scores = model.opacity.new_zeros(len(model))
    for inputs in _inputs(model, views):
        background = inputs.view.background.sum()
        for tile in fragments(inputs, model.falloff):
            light, color = tile.light, tile.color.sum(dim=1)[:, None]
            given = tile.alpha * light * color
            behind = given.sum(dim=0) - given.cumsum(dim=0)
            behind += background * (1 - tile.alpha).prod(dim=0)
            slope = tile.opacity[:, None] * (light * color - behind / (1 - tile.alpha))
            squared = slope.square() * tile.drawn
            scores.index_add_(0, tile.rows, squared.sum(dim=1))
    return scores


SCORES: dict[str, Score] = {
    "removal-error": removal_error,
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
    views: Iterable[View],
    engine: Engine,
    figure: Callable[[RasterOutputs], Tensor | None],
) -> Tensor:
    """(N,) sum over views of a figure (N,)."""
    scores = model.opacity.new_zeros(len(model))
    for inputs in _inputs(model, views):
        each = figure(engine.rasterize(inputs, model.falloff))
        assert each is not None
        scores += each
    return scores
