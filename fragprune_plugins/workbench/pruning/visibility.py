"""Finds and removes Gaussians that reach no pixel."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor

from fragprune_plugins.constants import ALPHA_MIN
from fragprune_plugins.engines import Engine
from fragprune_plugins.errors import InputError
from fragprune_plugins.files.model import Model
from fragprune_plugins.plugins.hooks import engine_for
from fragprune_plugins.types import RasterInputs, View


@torch.no_grad()
def visible(
    model: Model,
    views: Sequence[View] = (),
    *,
    engine: str | Engine = "auto",
) -> Tensor:
    """(N,) bool: the Gaussians whose removal could change a picture.

    Without views, these are the Gaussians with an opacity of 1/255 or more. With views, these are
    the Gaussians that reach the centre of a pixel in at least one view, hidden by others or not.
    Without the other Gaussians, the pictures of the views are the same to the bit if activated
    values are. (torch.sigmoid may round an opacity differently in another row.)

    Args:
        model: N Gaussians. Its own thresholds count, not the answers of plugins.
        views: the views whose pictures must stay the same.
        engine: a name or an engine.

    Raises:
        InputError: no Gaussian is visible.
    """
    splats = model.splats()
    seen = splats.opacities >= ALPHA_MIN
    if views:
        drawer = engine_for(engine, splats.device) if isinstance(engine, str) else engine
        seen = torch.zeros_like(seen)
        for view in views:
            # Alpha capped at its least cuts and hides no Gaussian: light is left behind two
            # thousand Gaussians. So those count too that end a pixel without being drawn in it.
            inputs = RasterInputs(view, splats, counts=True, alpha_max=ALPHA_MIN, planes=())
            counts = drawer.rasterize(inputs, model.falloff).fragments_per_gaussian
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
