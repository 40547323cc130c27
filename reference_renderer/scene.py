"""The oracle's inputs and outputs."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any, Final, Literal, TypeVar

from torch import Tensor

RIM_WIDTH: Final = 0.01
"""Width w, in falloff, of the logistic surrogate at the rim."""

RIM_REACH: Final = 4.6
"""Fragments down to tau - RIM_REACH * RIM_WIDTH feel the surrogate: there s(1-s) is 0.01."""

FALLOFF_MIN: Final = 1e-4
"""Least falloff that reach may take: keeps -2 ln(.) finite."""


SomeTable = TypeVar("SomeTable", bound="Table")


class Table:
    """A dataclass whose tensors have a row for each Gaussian."""

    def take(self: SomeTable, rows: Tensor) -> SomeTable:
        """The same of these rows (K,), in their order; all others get zero gradient."""
        tensors = {name: each for name, each in vars(self).items() if isinstance(each, Tensor)}
        taken: dict[str, Any] = {name: each[rows] for name, each in tensors.items()}
        return replace(self, **taken)  # type: ignore[type-var]


@dataclass(frozen=True)
class Camera:
    """One camera. Matrices act on row vectors: ``p_view = [p, 1] @ viewmatrix``.

    Attributes:
        width: pixels.
        height: pixels.
        tan_fov_x: tangent of half the horizontal field of view.
        tan_fov_y: tangent of half the vertical field of view.
        viewmatrix: (4, 4) world to camera, x right, y down, z forward.
        projmatrix: (4, 4) world to clip.
        campos: (3,) camera centre in the world.
        background: (3,) RGB.
    """

    width: int
    height: int
    tan_fov_x: float
    tan_fov_y: float
    viewmatrix: Tensor
    projmatrix: Tensor
    campos: Tensor
    background: Tensor


@dataclass(frozen=True)
class Gaussians(Table):
    """N activated Gaussians; either scales and rotations or cov3d, either sh or colors.

    Attributes:
        means: (N, 3) world.
        opacities: (N,) in (0, 1).
        scales: (N, 3) standard deviations, world units; (N, 2) of surfels, see ``flat``.
        rotations: (N, 4) quaternions w, x, y, z, used as given.
        cov3d: (N, 6) upper triangle xx, xy, xz, yy, yz, zz.
        sh: (N, K, 3) with K = (sh_degree + 1)^2 or more.
        colors: (N, 3) RGB, used as given.
        sh_degree: 0 to 3.
        features: (N, F) more channels to blend, or None.
    """

    means: Tensor
    opacities: Tensor
    scales: Tensor | None = None
    rotations: Tensor | None = None
    cov3d: Tensor | None = None
    sh: Tensor | None = None
    colors: Tensor | None = None
    sh_degree: int = 0
    features: Tensor | None = None

    @property
    def flat(self) -> bool:
        """Whether they are surfels, which lie in the plane of their first two axes."""
        return self.scales is not None and self.scales.shape[1] == 2


@dataclass(frozen=True)
class Options:
    """The numbers of a dialect. With the three cuts at 0 the renderer is differentiable everywhere.

    Surfels take no dilation, compensation, sample_offsets or absolute_gradient.

    Attributes:
        scale_modifier: factor on the scales; cov3d is used as given.
        dilation: pixels^2 added to the 2D covariance's diagonal.
        compensation: factor on opacity for the dilation, see ``compensate_*`` in project.py.
        near: view depth at or below which a Gaussian is culled.
        alpha_min: fainter fragments are skipped; 0 skips none.
        alpha_max: alpha is capped here.
        cap_gradient: the gradient passes through the cap; else it is 0 where alpha was capped.
        transmittance_min: a pixel stops before a fragment that would leave less; 0 for no stop.
        stop: a pixel draws the fragment that leaves less than this, and stops behind it; None for
            the rule of transmittance_min, which is ignored otherwise.
        tiles: draw a Gaussian only in the 16x16 tiles of its 3-sigma square; else everywhere.
        sample_offsets: (H, W, 2) pixels, added to where each pixel is sampled; or None.
        absolute_gradient: the hook's third column receives the sum over pixels of the absolute
            values of their contributions to the first two; else 0.
        rim: "hard" cuts at the threshold, with the surrogate's gradient; "soft" multiplies alpha by
            the share of the pixel that is covered, with true derivatives; "surrogate" by the
            surrogate itself, everywhere. Surfels know no soft rim.
    """

    scale_modifier: float = 1.0
    dilation: float = 0.3
    compensation: Literal["none", "antialiasing", "mip"] = "none"
    near: float = 0.2
    alpha_min: float = 1.0 / 255.0
    alpha_max: float = 0.99
    cap_gradient: bool = True
    transmittance_min: float = 1e-4
    stop: float | None = None
    tiles: bool = True
    sample_offsets: Tensor | None = None
    absolute_gradient: bool = False
    rim: Literal["hard", "soft", "surrogate"] = "hard"


@dataclass(frozen=True)
class Rendering:
    """What ``render`` returns.

    Attributes:
        image: (3, H, W) RGB with background, not clamped.
        radii: (N,) int32 pixels, ceil(3 sigma); 0 when culled. Thresholds never change it.
        invdepth: (1, H, W) sum of alpha T / z, without background; of surfels, z of the mean.
        alpha: (1, H, W) 1 - final transmittance.
        fragments_per_pixel: scalar, drawn fragments over pixels; its gradient in the thresholds is
            the surrogate's.
        fragments: (H, W) int32 drawn fragments of each pixel.
        fragments_per_gaussian: (N,) int32 drawn fragments of each Gaussian.
        evaluated: (Gaussian, pixel) pairs tested.
        entries: (Gaussian, tile) pairs.
        features: (F, H, W) sum of alpha T feature; None where none were given.
        weights_per_gaussian: (N,) sum of alpha T over its drawn fragments; a constant.
        winners: (H, W) int32 row of the Gaussian of largest alpha T, the first in depth order of
            equal ones, -1 where nothing is drawn.
        wins_per_gaussian: (N,) int32 pixels that each wins.
        surface: (6, H, W) of surfels, see ``surfel.surface_of``; None of others.
    """

    image: Tensor
    radii: Tensor
    invdepth: Tensor
    alpha: Tensor
    fragments_per_pixel: Tensor
    fragments: Tensor
    fragments_per_gaussian: Tensor
    evaluated: int
    entries: int
    features: Tensor | None
    weights_per_gaussian: Tensor
    winners: Tensor
    wins_per_gaussian: Tensor
    surface: Tensor | None = None
