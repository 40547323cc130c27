"""Moves Gaussians, while a model learns, from where they are worth least to where some are missing.

A training ends with Gaussians that its photographs hardly need, and with others that stand for more
than one can show: photographs pull hard at their positions. Each of the latter is split in two, and
one of the former becomes its second half. (3DGS-MCMC, NeurIPS 2024, moves Gaussians in a training;
Improved-GS, 2025, splits them along the longest axis.)
"""

from __future__ import annotations

import contextlib
import math
from collections.abc import Iterable, Iterator, Mapping
from typing import Any

import torch
from torch import Tensor

from fragprune_plugins.engines import Engine
from fragprune_plugins.errors import InputError
from fragprune_plugins.files.model import Model
from fragprune_plugins.learning.pressure import ElasticPressure, PressureRule
from fragprune_plugins.learning.schedule import Settings
from fragprune_plugins.learning.thresholds import MOMENTS, ThresholdStore
from fragprune_plugins.plugins.hooks import engine_for
from fragprune_plugins.types import View
from fragprune_plugins.workbench.goals import AtMost
from fragprune_plugins.workbench.pruning import removal_error

SHARE = 0.15
"""Of the Gaussians, that move; docs/experiments/defaults.md has the runs that chose all these."""

PACE = 0.02
"""Of its longest axis, that a Gaussian moves in a step at first: what moved has a place to find.

A rate in units of the scene suits one scene, and is three times too fast or slow for another.
"""

COMPACT = 0.1
"""Per cents of the loss that one of the ellipses' area is worth while Gaussians move."""

DEEPER = 1.6
"""Times the usual default pressure, and its upper end: the better picture affords deeper cuts."""

Moments = Mapping[Tensor, Mapping[str, Any]]

_LEAST_AREA = 1e-12  # per pixel: a view may show nothing, and has no gradient then
_LARGEST = 3.0  # medians, of the size that counts: skies take steps that change much of a picture
_ROUNDS, _FIRST, _LAST = 10, 0.05, 0.3  # of the run: what moves later has not settled at its end
_APART = 0.7  # twins' distance from the whole, over its longest axis: they are as long together
_OPACITY = 0.7  # of a twin, over that of the whole


def relocates(model: Model, settings: Settings) -> bool:
    """Whether Gaussians may move: where photographs teach all of a model, and none is left out."""
    able = settings.train == "all" and model.filter_3d is None
    return able and not (settings.dropout or settings.itself or isinstance(settings.goal, AtMost))


def spare(model: Model, views: Iterable[View], *, engine: str | Engine = "auto") -> Tensor:
    """(M,) int64: the Gaussians that may move, for ``finetune(relocate=)``.

    They are 15 % of the model's, those of the least ``removal_error``, the least first.

    Args:
        views: to score them on, on the model's device, such as those that ``views_near`` gives.
        engine: a name or an engine.
    """
    return least(removal_error(model, views, engine_for(engine, model.device)))


def least(scores: Tensor) -> Tensor:
    """(M,) int64: the rows of a share of the scores (N,), the least first."""
    return scores.argsort(stable=True)[: int(SHARE * len(scores))]


class Relocation:
    """Gaussians on the move in a run.

    Args:
        rows: (M,) int64, of N Gaussians those that move, the one worth least first.
        scaling: (N, 2 or 3) logarithms of the sizes of the N, at least 2 M.
        steps: of the run.

    Raises:
        InputError: these are not such rows.

    Attributes:
        rate: initial learning rate of positions, for a Gaussian of median size.
        pull: (2, N) float32, since the last move: how much the loss would change if a Gaussian
            moved by its own size, summed over the views that see it, and the number of these.
    """

    def __init__(self, rows: Tensor, scaling: Tensor, steps: int) -> None:
        count = len(scaling)
        known = rows.dtype == torch.int64 and rows.ndim == 1 and 2 * len(rows) <= count
        if not known or len(set(rows.tolist())) < len(rows) or ((rows < 0) | (rows >= count)).any():
            found = f"{rows.dtype} of shape {tuple(rows.shape)}, or a row twice, or of no Gaussian"
            expected = f"torch.int64, at most half of {count} rows, each once"
            raise InputError("relocate", found, expected, "Pass what spare(model, views) gives.")
        self._rows, self._steps = rows, steps
        self._median = float(_sizes(scaling).median())
        self.rate = PACE * self._median
        self.pull = torch.zeros(2, count, device=rows.device)

    def moved(self, step: int) -> int:
        """How many have moved when a step is over."""
        over = (step / self._steps - _FIRST) / (_LAST - _FIRST)
        return len(self._rows) * int(_ROUNDS * min(1.0, max(0.0, over))) // _ROUNDS

    def over(self, step: int) -> bool:
        """Whether all have moved when a step begins."""
        return self.moved(step - 1) == len(self._rows)

    @contextlib.contextmanager
    def stepping(
        self, step: int, parameters: Mapping[str, Tensor], store: ThresholdStore, state: Moments
    ) -> Iterator[None]:
        """Inside, the optimizer steps: large Gaussians further than small ones; then some move.

        Args:
            step: counted from 1.
            parameters: that the optimizer moves, by their names in a ``Model``, and whatever else
                has a row for each Gaussian; changed in place.
            state: of the optimizer, by parameter.
        """
        xyz, scaling = parameters["xyz"], parameters["scaling"]
        before, sizes = xyz.detach().clone(), _sizes(scaling) / self._median
        yield
        with torch.no_grad():
            xyz.copy_(before.lerp(xyz, sizes.clamp(max=_LARGEST)[:, None]))
            if not self.over(step):
                self._move(step, parameters, store, state)

    def _move(
        self, step: int, parameters: Mapping[str, Tensor], store: ThresholdStore, state: Moments
    ) -> None:
        """Split what is pulled hardest, if some are due to move in this step."""
        xyz = parameters["xyz"]
        assert xyz.grad is not None
        pull = xyz.grad.norm(dim=1) * _sizes(parameters["scaling"])
        self.pull += torch.stack([pull, (pull > 0).float()])
        leaving = self._rows[self.moved(step - 1) : self.moved(step)]
        if not len(leaving):
            return
        mean = self.pull[0] / self.pull[1].clamp(min=1)
        mean[self._rows[self.moved(step - 1) :]] = -1  # what is to go itself
        wholes = mean.topk(len(leaving)).indices
        split(parameters, wholes, leaving)
        twins = torch.cat([wholes, leaving])
        for parameter in parameters.values():
            if parameter.grad is not None:  # of an optimizer that has still to step
                parameter.grad[twins] = 0
            known = state.get(parameter, {})  # nothing, if no loss has moved it
            for moment in MOMENTS.keys() & known.keys():
                known[moment][twins] = 0
        origins = torch.arange(len(store), device=twins.device)
        fresh = torch.isin(origins, twins)
        origins[leaving] = wholes
        store.rearrange(origins, fresh)
        self.pull.zero_()


def price(loss: Tensor, area: Tensor) -> Tensor:
    """What the ellipses' area per pixel (``area_per_pixel``) costs beside a loss, in its units."""
    return COMPACT * loss.detach() * area.clamp(min=_LEAST_AREA).log()


def deepen(pressure: PressureRule) -> None:
    """Raise the usual default pressure of a run in which Gaussians move."""
    if isinstance(pressure, ElasticPressure):
        pressure.elasticity *= DEEPER
        pressure.most *= DEEPER


def _sizes(scaling: Tensor) -> Tensor:
    """(N,) the longest axes."""
    return scaling.detach().exp().amax(dim=1)


def split(parameters: Mapping[str, Tensor], wholes: Tensor, others: Tensor) -> None:
    """Make two of each of some Gaussians, side by side along its longest axis.

    Args:
        parameters: of a ``Model``, by name, each (N, ...); changed in place.
        wholes: (K,) int64, the rows that are split.
        others: (K,) int64, the rows of what is lost for the second halves.
    """
    for each in parameters.values():
        each[others] = each[wholes]
    sizes = parameters["scaling"][wholes].exp()
    size, axis = sizes.max(dim=1)
    longest = torch.nn.functional.one_hot(axis, sizes.shape[1]).to(size)
    along = torch.nn.functional.pad(longest, (0, 3 - sizes.shape[1]))  # a surfel has two axes
    q = torch.nn.functional.normalize(parameters["rotation"][wholes])
    w, v = q[:, :1], q[:, 1:]
    twice = 2 * torch.linalg.cross(v, along)
    offset = _APART * size[:, None] * (along + w * twice + torch.linalg.cross(v, twice))
    for rows, side in ((wholes, 1), (others, -1)):
        parameters["xyz"][rows] += side * offset
        parameters["scaling"][rows] += longest * (0.5 * math.log(1 - _APART**2))
        opacity = parameters["opacity"][rows].sigmoid() * _OPACITY
        parameters["opacity"][rows] = opacity.logit(1e-6)
