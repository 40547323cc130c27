"""Which Gaussians can go: those worth least to the pictures, and those that reach no pixel."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import replace
from typing import Literal

import torch
from torch import Tensor
from tqdm import tqdm

from fragprune_plugins.constants import ALPHA_MIN
from fragprune_plugins.engines import Engine
from fragprune_plugins.errors import InputError
from fragprune_plugins.files.model import Model
from fragprune_plugins.plugins.hooks import engine_for
from fragprune_plugins.types import RasterInputs, View
from fragprune_plugins.workbench.scenes.dataset import Shot, shots_of

Keep = float | Literal["auto", "visible"]  # what ``--keep`` leaves: a share, or a rule

SPARE = 0.005
"""Share of the squared error up to which ``keep_needed`` removes. Errors of neighbours add up, so
it rises by more, and learning makes up for it: 14 %, 15 % and 30 % of the Gaussians of three scenes
went for 0.03 dB or less."""

LEAST = 0.6
"""Share of the Gaussians that ``keep_needed`` leaves at least: where the error is large, as in the
first steps of a training, single changes say little of what many of them do together."""


def kept(
    model: Model,
    keep: Keep,
    shots: Sequence[Shot],
    views: Sequence[View],
    *,
    engine: str | Engine = "auto",
    progress: bool = False,
    scores: Tensor | None = None,
) -> Tensor:
    """(N,) bool: the Gaussians that ``--keep`` leaves, by views whose pictures must not change.

    Args:
        keep: a share of them in (0, 1]; "auto" for what ``keep_needed`` leaves, or "visible".
        shots: the photographs to learn from, on the model's device.
        scores: (N,) of these views, if they are known (``scored``).

    Raises:
        InputError: the share is not in (0, 1], there is no view, or no Gaussian is visible.
    """
    drawer = engine_for(engine, model.device)
    if keep == "visible":
        return visible(model, views, engine=drawer)
    if not views or (keep == "auto" and not shots):
        raise InputError("keep", "no view to judge by", "at least one", "Pass views of the model.")
    if scores is None:
        scores = scored(model, views, engine=drawer, progress=progress)
    if keep != "auto":
        return best(scores, keep)
    spared = SPARE * _error(model, shots, drawer) * len(views) / len(shots)
    each, least = scores.double().sort(stable=True)
    goes = int((each.cumsum(0) <= spared).sum())
    stays = best(scores, LEAST)
    stays[least[goes:]] = True
    return stays


def scored(model: Model, views: Sequence[View], *, engine: Engine, progress: bool) -> Tensor:
    """(N,) ``removal_error``, with a bar on stderr if there is ``progress``."""
    bar = tqdm(views, "scoring Gaussians", unit="view", leave=None, disable=not progress)
    return removal_error(model, bar, engine)


@torch.no_grad()
def _error(model: Model, shots: Iterable[Shot], engine: Engine) -> float:
    """Squared error of a model in all photographs."""
    splats, error = model.splats(), 0.0
    for shot in shots:
        inputs = RasterInputs(shot.view, splats, planes=(), **model.rules)
        image = engine.rasterize(inputs, model.falloff).image
        error += float((shot.looked_at(image).clamp(0, 1) - shot.image).square().sum())
    return error


def keep_best(
    model: Model,
    share: float,
    views: Sequence[View],
    *,
    engine: str | Engine = "auto",
    progress: bool = False,
) -> Model:
    """Copy a model without the Gaussians of the least ``removal_error``.

    Thresholds keep their moments. With ``progress`` a bar is drawn on stderr.

    Args:
        share: of the Gaussians to keep, in (0, 1]; at least one is kept.
        views: to score them on, on the model's device.

    Raises:
        InputError: the share is not in (0, 1].
    """
    return model.keep(kept(model, share, (), views, engine=engine, progress=progress))


def keep_needed(
    model: Model,
    shots: Sequence[Shot],
    views: Sequence[View] = (),
    *,
    engine: str | Engine = "auto",
    progress: bool = False,
) -> Model:
    """Copy a model without the Gaussians that its photographs can spare.

    Those of the least ``removal_error`` go, until the errors of a view add up to ``SPARE`` of the
    squared error of the whole model in a photograph, or ``LEAST`` of the Gaussians are left.
    Thresholds keep their moments. With ``progress`` a bar is drawn on stderr.

    Args:
        shots: the photographs to learn from, on the model's device.
        views: whose pictures must not change; those of the photographs when empty.
    """
    shots = shots_of("keep_needed", shots)
    views = views or [shot.view for shot in shots]
    return model.keep(kept(model, "auto", shots, views, engine=engine, progress=progress))


def best(scores: Tensor, share: float) -> Tensor:
    """(N,) bool: the share in (0, 1] with the largest scores (N,); of equal ones the first rows."""
    if not 0 < share <= 1:
        raise InputError("share", f"{share:g}", "0 < X <= 1", "Choose one, such as 0.6.")
    count = max(1, round(share * len(scores)))
    kept = torch.zeros_like(scores, dtype=torch.bool)
    kept[scores.argsort(descending=True, stable=True)[:count]] = True
    return kept


def removal_error(model: Model, views: Iterable[View], engine: Engine) -> Tensor:
    """Squared change of all pictures if this Gaussian alone went, estimated; the same every time.

    A pixel is linear in a fragment's alpha, so its change is alpha times the gradient by alpha.
    The sum of squares over pixels is the mean square of gradients by the opacity of pictures
    whose values have random signs (Hutchinson's estimator): one backward pass a view, on any
    engine, so give many views. A pixel's stop at little transmittance is left out.
    """
    splats = model.splats()
    opacities = splats.opacities.detach().clone().requires_grad_(True)
    splats = replace(splats, opacities=opacities)
    where = opacities.device if opacities.is_cuda else "cpu"  # a GPU would wait for a CPU's numbers
    stream = torch.Generator(where).manual_seed(0)
    scores = torch.zeros_like(opacities)
    for view in views:
        inputs = RasterInputs(view, splats, planes=(), **model.rules)
        image = engine.rasterize(inputs, model.falloff).image
        signs = torch.randint(0, 2, image.shape, generator=stream, device=where)
        signs = signs.mul(2).sub(1).to(image)
        (slope,) = torch.autograd.grad(image, opacities, signs)
        scores += (opacities.detach() * slope).square()
    return scores.detach()


@torch.no_grad()
def visible(model: Model, views: Sequence[View] = (), *, engine: str | Engine = "auto") -> Tensor:
    """(N,) bool: the Gaussians whose removal could change a picture; InputError if there is none.

    Without views, these have an opacity of 1/255 or more. With views, they reach the centre of a
    pixel in one of them, hidden by others or not; without the rest the pictures are the same to the
    bit if activated values are (torch.sigmoid may round differently in another row). The model's
    own thresholds count, not the answers of plugins.
    """
    splats = model.splats()
    seen = splats.opacities >= ALPHA_MIN
    if views:
        drawer = engine_for(engine, splats.device)
        seen = torch.zeros_like(seen)
        for view in views:
            # Alpha capped at its least cuts and hides no Gaussian: light is left behind two
            # thousand Gaussians. So those count too that end a pixel without being drawn in it.
            inputs = RasterInputs(view, splats, counts=True, alpha_max=ALPHA_MIN, planes=())
            counts = drawer.rasterize(inputs, model.falloff).fragments_per_gaussian
            assert counts is not None
            seen |= counts > 0
    if not seen.any():
        found, expected = f"none of {len(model)} Gaussians reaches a pixel", "some that do"
        raise InputError("model", found, expected, "Check that model and views belong together.")
    return seen
