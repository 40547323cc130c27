"""Gaussians that a model can do without: those that reach no pixel."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor

from fragprune_plugins.constants import ALPHA_MIN
from fragprune_plugins.engines import Engine
from fragprune_plugins.errors import InputError
from fragprune_plugins.learning.thresholds import ThresholdStore
from fragprune_plugins.plugins.hooks import engine_for
from fragprune_plugins.storage.ply import SplatFile
from fragprune_plugins.types import RasterInputs, View


def drop_invisible(
    model: SplatFile,
    store: ThresholdStore,
    views: Sequence[View] = (),
    *,
    engine: str | Engine = "auto",
) -> tuple[SplatFile, ThresholdStore]:
    """A model and its thresholds without the rows that are not ``visible``; both stay as they were.

    Thresholds keep their moments. It goes by what the store holds, whatever plugins answer.

    Raises:
        InputError: none is visible.
    """
    kept = visible(model, None if store.neutral else store.values.detach(), views, engine=engine)
    smaller = ThresholdStore(0, store.logits.device)
    smaller.load_state_dict(store.state_dict())
    smaller.keep(kept)
    return model.keep(kept), smaller


@torch.no_grad()
def visible(
    model: SplatFile,
    thresholds: Tensor | None = None,
    views: Sequence[View] = (),
    *,
    engine: str | Engine = "auto",
) -> Tensor:
    """(N,) bool: Gaussians without which a picture could change.

    Without views these are all that have an ellipse at all: opacity of 1/255 or more. With views,
    those that reach the centre of a pixel in one of them, hidden by others there or not. Pictures
    of the views are the same to the bit without the others, if activated values are: torch.sigmoid
    may round an opacity otherwise where it stands in another row.

    Args:
        model: N Gaussians.
        thresholds: (N,) falloff in (0, 1), or None for no truncation.
        views: all that must stay as they are.
        engine: a name or an engine.

    Raises:
        InputError: there is none.
    """
    splats = model.splats()
    seen = splats.opacities >= ALPHA_MIN
    if views:
        drawer = engine_for(engine, splats.device) if isinstance(engine, str) else engine
        seen = torch.zeros_like(seen)
        for view in views:
            # Alpha capped at its least cuts nobody, and hides nobody: light is left behind two
            # thousand Gaussians. So those count too that end a pixel without being drawn in it.
            inputs = RasterInputs(view, splats, counts=True, alpha_max=ALPHA_MIN)
            counts = drawer.rasterize(inputs, thresholds).fragments_per_gaussian
            assert counts is not None
            seen |= counts > 0
    if not seen.any():
        raise InputError(
            "model",
            f"none of {len(model)} Gaussians reaches a pixel",
            "some that do",
            "Check that model and views belong together.",
        )
    return seen
