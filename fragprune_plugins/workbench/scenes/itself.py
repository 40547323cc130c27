"""A model's own pictures instead of photographs: what it showed as it came in."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import ClassVar

import torch
from torch import Tensor

from fragprune_plugins.engines import Engine
from fragprune_plugins.files.model import Model
from fragprune_plugins.plugins.hooks import engine_for
from fragprune_plugins.types import RasterInputs, View, one_line
from fragprune_plugins.workbench.models import model as models
from fragprune_plugins.workbench.scenes.dataset import Dataset, Shot
from fragprune_plugins.workbench.scenes.generated import Named, around, between, hold_out


@dataclass(frozen=True, eq=False)
class OwnPicture(Shot):
    """A camera, and the picture that a model gives there.

    Attributes:
        draw: draws it, (3, H, W). It is asked at every use: a forward pass more in a step costs
            less than to hold the pictures of hundreds of views, and rounds nothing.
    """

    target: ClassVar[str] = "itself"

    draw: Callable[[View], Tensor]

    __repr__ = one_line

    @property
    def image(self) -> Tensor:
        """(3, H, W) RGB on the view's device, not clamped."""
        return self.draw(self.view)


def own_pictures(
    model: Model | models.Trained | str | Path,
    cameras: Named | None = None,
    held_out: Named | None = None,
    *,
    engine: str | Engine = "auto",
    seed: int = 0,
) -> Dataset:
    """A model's own pictures, to learn its thresholds from without photographs.

    It is drawn as it came in: untruncated, or truncated by the thresholds that it has.

    Args:
        model: what ``load`` gave, the result of a training, or a file. It is kept.
        cameras: named views to learn from; views between near ones are added. None takes cameras
            all around the splat, which suit an object but no scene seen from within.
        held_out: named views for the figures; every eighth of ``cameras`` when None.
        engine: a name or an engine.
        seed: of what is generated.

    Raises:
        DatasetError: fewer than two cameras.
        EngineError: no such engine here.
    """
    model = models.of(model)
    draw = _drawing(model, engine)
    views = around(model, seed=seed) if cameras is None else cameras
    if held_out is None:
        views, held_out = hold_out(views)
    train, test = (
        [OwnPicture(name, view, draw) for name, view in part]
        for part in ([*views, *between(views, seed=seed)], held_out)
    )
    return Dataset(train, test).to(model.device)


def _drawing(model: Model, engine: str | Engine) -> Callable[[View], Tensor]:
    """Draws a model as it is now, (3, H, W)."""
    drawer = engine_for(engine, model.device) if isinstance(engine, str) else engine
    splats, thresholds = model.splats(), model.falloff

    @torch.no_grad()
    def draw(view: View) -> Tensor:
        inputs = RasterInputs(view, splats, planes=(), **model.rules)
        return drawer.rasterize(inputs, thresholds).image

    return draw
