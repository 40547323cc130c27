"""Gaussians in space and time, a moment, and the 3D Gaussians that they are then."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Final

from fragprune_plugins.errors import InputError
from fragprune_plugins.types import check_degree, check_fields, check_values, one_line

if TYPE_CHECKING:
    import torch
    from torch import Tensor

MARGINAL_MIN: Final = 0.05
"""A Gaussian is not there when the moment is this unlikely for it, 1 at its mean in time."""


@dataclass(frozen=True)
class SpacetimeSplats:
    """N Gaussians in space and time, activated; a ``Moment`` cuts them.

    They are given in one of four ways. ``cov3d``: sliced already, only colours depend on the
    moment. ``scales`` and ``rotations``: in space alone. With ``times`` and ``scales_t``: in time,
    apart from space. With ``rotations_r`` too: with axes anywhere in space and time.

    Attributes:
        means: (N, 3) world.
        opacities: (N,) in (0, 1).
        times: (N,) means in time.
        scales: (N, 3) standard deviations, world units.
        scales_t: (N,) in time: a standard deviation with ``rotations_r``, else a variance.
        rotations: (N, 4) quaternions w, x, y, z; used as given, the host normalises.
        rotations_r: (N, 4) the right ones; ``rotations`` are the left ones then.
        cov3d: (N, 6) upper triangle xx, xy, xz, yy, yz, zz; scale_modifier does not apply.
        sh: (N, K, 3), 16 coefficients to each cosine in time; None for no colours.
        sh_degree: 0 to 3, how many bands of ``sh`` are used.
    """

    means: Tensor
    opacities: Tensor
    times: Tensor | None = None
    scales: Tensor | None = None
    scales_t: Tensor | None = None
    rotations: Tensor | None = None
    rotations_r: Tensor | None = None
    cov3d: Tensor | None = None
    sh: Tensor | None = None
    sh_degree: int = 0

    __repr__ = one_line

    def __post_init__(self) -> None:
        check_fields(self, means=(None, 3))
        n = len(self.means)
        check_fields(self, opacities=(n,), times=(n,), scales=(n, 3), scales_t=(n,))
        check_fields(self, rotations=(n, 4), rotations_r=(n, 4), cov3d=(n, 6), sh=(n, None, 3))
        given = {name for name in set().union(*_KINDS) if getattr(self, name) is not None}
        if given not in _KINDS or ("scales_t" in given and self.times is None):
            found = "cov3d, scales, rotations and times as given"
            expected = "cov3d alone, or scales and rotations, with scales_t and times, "
            expected += "with rotations_r"
            raise InputError("SpacetimeSplats", found, expected, "Pass one of the four.")
        check_degree("SpacetimeSplats", self.sh, self.sh_degree)

    def __len__(self) -> int:
        return len(self.means)

    @property
    def device(self) -> torch.device:
        """The device of the Gaussians."""
        return self.means.device


_KINDS: Final = (
    {"cov3d"},
    {"scales", "rotations"},
    {"scales", "rotations", "scales_t"},
    {"scales", "rotations", "scales_t", "rotations_r"},
)


@dataclass(frozen=True)
class Moment:
    """A moment and a camera position at which Gaussians in space and time are cut.

    Attributes:
        timestamp: the moment.
        campos: (3,) camera centre in the world, for colour.
        duration: longest period of the colours' cosines in time; above 0.
        sh_degree_t: how many cosines are used at ``sh_degree`` 3, 0 to 2; None for colours without
            time.
        prefilter_var: if positive, added to the variance in time of the marginal.
        scale_modifier: factor on the scales.
    """

    timestamp: float
    campos: Tensor
    duration: float = 1.0
    sh_degree_t: int | None = None
    prefilter_var: float = -1.0
    scale_modifier: float = 1.0

    __repr__ = one_line

    def __post_init__(self) -> None:
        check_fields(self, campos=(3,))
        check_values(
            self,
            duration=(self.duration > 0, "above 0"),
            sh_degree_t=(self.sh_degree_t in (None, 0, 1, 2), "None, 0, 1 or 2"),
        )


@dataclass(frozen=True)
class Sliced:
    """N Gaussians at a moment. Absent ones have their mean at the camera and zeros elsewhere.

    Attributes:
        means: (N, 3) world.
        cov3d: (N, 6) upper triangle xx, xy, xz, yy, yz, zz.
        opacities: (N,) multiplied by the likelihood of the moment.
        present: (N,) bool: whether the likelihood of the moment (1 at the mean in time) exceeds
            0.05 and the covariance is finite.
        colors: (N, 3) RGB, not below 0; None without ``sh``.
    """

    means: Tensor
    cov3d: Tensor
    opacities: Tensor
    present: Tensor
    colors: Tensor | None = None

    __repr__ = one_line
