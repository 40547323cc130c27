"""Rules that are not learned, to compare learning with.

A ``Rule`` gives thresholds that follow from opacities. A ``Start`` changes the Gaussians themselves
once, before they train.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from torch import Tensor

    from fragprune_plugins.files.model import Model


@dataclass(frozen=True)
class Rule:
    """Thresholds as a function of opacities.

    Attributes:
        name: says which function, with its numbers; recorded with results.
        thresholds: gives (N,) falloff in (0, 1] from (N,) activated opacities. At 1 no more than a
            Gaussian's very centre is left.
    """

    name: str
    thresholds: Callable[[Tensor], Tensor]

    def __call__(self, opacities: Tensor) -> Tensor:
        """The thresholds (N,) for activated opacities (N,)."""
        return self.thresholds(opacities)


def falloff_threshold(tau: float) -> Rule:
    """One threshold for all Gaussians: each is cut at the same number of standard deviations.

    Args:
        tau: falloff in (0, 1).
    """
    return Rule(
        f"falloff_threshold({tau:g})", lambda opacities: opacities.new_full(opacities.shape, tau)
    )


def alpha_cutoff(levels: float) -> Rule:
    """One limit of alpha for all Gaussians: their thresholds are the limit over their opacities.

    Args:
        levels: the limit in steps of 8 bits, above 0; 1 is the hosts' own limit.
    """
    limit = levels / 255
    return Rule(f"alpha_cutoff({levels:g})", lambda opacities: (limit / opacities).clamp_max(1.0))


@dataclass(frozen=True)
class Start:
    """A change to a model before it trains.

    Attributes:
        name: says which change, with its numbers; recorded with results.
        model: gives the changed model.
    """

    name: str
    model: Callable[[Model], Model]

    def __call__(self, model: Model) -> Model:
        """The changed model."""
        return self.model(model)


def shrunk(factor: float) -> Start:
    """All Gaussians shrink alike: scale decay.

    Args:
        factor: on their standard deviations, in (0, 1).
    """
    return Start(
        f"shrunk({factor:g})",
        lambda model: replace(model, scaling=model.scaling + math.log(factor)),
    )


def without_faint(opacity: float) -> Start:
    """Without the Gaussians whose opacity lies below a limit in (0, 1)."""
    return Start(
        f"without_faint({opacity:g})",
        lambda model: model.keep(model.opacity[:, 0].sigmoid() >= opacity),
    )
