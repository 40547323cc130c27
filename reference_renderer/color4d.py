"""Colour by direction and time: spherical harmonics times cosines, as in RT-4DGS.

The picture uses directions to the stored means. The host's backward pass uses directions to the
moved means instead. Its hand-written gradients of colours in time have further errors, listed at
``_slope``. Training follows those gradients, so we reproduce them.
"""

from __future__ import annotations

from dataclasses import dataclass
from math import pi

import torch
from torch import Tensor

from reference_renderer.sh import sh_basis

BANDS = 16
"""Coefficients of degree 3; time modulates them only when all are in use."""


@dataclass(frozen=True)
class Clock:
    """The quantities on which colours in time depend.

    Attributes:
        times: (N,) means in time.
        timestamp: the moment.
        duration: of the whole recording, the cosines' longest period.
        degree: how many cosines are in use, 0 to 2.
    """

    times: Tensor
    timestamp: float
    duration: float
    degree: int

    def wave(self, order: int, times: Tensor | None = None) -> Tensor:
        """(N,) cosine of an order, 1 and up."""
        since = (self.times if times is None else times) - self.timestamp
        return torch.cos(2 * pi * order * since / self.duration)


def colors(
    sh: Tensor, means: Tensor, moved: Tensor, campos: Tensor, degree: int, clock: Clock | None
) -> Tensor:
    """(N, 3) RGB, not below 0.

    Args:
        sh: (N, K, 3), K at least (degree + 1)^2, plus 16 for each cosine.
        means: (N, 3) the stored means.
        moved: (N, 3) the means at the moment.
        campos: (3,).
        degree: of the harmonics in use, 0 to 3.
        clock: None for colours that do not depend on time.
    """
    with torch.no_grad():
        harmonics = sh_basis(_towards(means, campos), degree)
        value = _blend(sh, harmonics, clock) + 0.5
    asked = (sh, moved) if clock is None else (sh, moved, clock.times)
    if torch.is_grad_enabled() and any(tensor.requires_grad for tensor in asked):
        slope = _slope(sh, sh_basis(_towards(moved, campos), degree), clock)
        value = value + (slope - slope.detach())
    return value.clamp_min(0)


def _towards(means: Tensor, campos: Tensor) -> Tensor:
    return torch.nn.functional.normalize(means - campos, dim=-1)


def _orders(harmonics: Tensor, clock: Clock | None) -> range:
    """Orders of the cosines in use: none below degree 3."""
    used = clock.degree if clock is not None and harmonics.shape[1] == BANDS else 0
    return range(1, used + 1)


def _sum(harmonics: Tensor, sh: Tensor, order: int = 0) -> Tensor:
    """(N, 3) harmonics (N, K) weighed by the coefficients of one cosine."""
    count = harmonics.shape[1]
    return torch.einsum("nk,nkc->nc", harmonics, sh[:, BANDS * order : BANDS * order + count])


def _blend(sh: Tensor, harmonics: Tensor, clock: Clock | None) -> Tensor:
    """(N, 3) the sum over harmonics and cosines."""
    total = _sum(harmonics, sh)
    for order in _orders(harmonics, clock):
        assert clock is not None
        total = total + clock.wave(order)[:, None] * _sum(harmonics, sh, order)
    return total


def _slope(sh: Tensor, harmonics: Tensor, clock: Clock | None) -> Tensor:
    """(N, 3) a tensor with the host's gradient; its value is not used.

    If time modulates colours, the host gives the second coefficient the gradient of the first, and
    the means in time only the gradient of the highest cosine, with the opposite sign.
    """
    if clock is None:
        return _blend(sh, harmonics, None)
    given = harmonics.detach().clone()
    given[:, 1:2] = given[:, :1]
    total = _sum(harmonics, sh.detach()) + _sum(given, sh)
    orders = _orders(harmonics, clock)
    for order in orders:
        still = clock.times.detach()
        times = 2 * still - clock.times if order == orders[-1] else still
        total = total + clock.wave(order, times)[:, None] * _sum(harmonics, sh, order)
    return total
