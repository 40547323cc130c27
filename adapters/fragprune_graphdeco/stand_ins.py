"""Stand-ins: our modules under the import names of the hosts' compiled packages.

They are used if the package cannot be imported or the run has no GPU. Our engine draws the call.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from inspect import Parameter, Signature
from types import ModuleType
from typing import Any, NamedTuple

import numpy as np
import torch
from torch import Tensor, nn

from fragprune_graphdeco.call import ARGUMENTS
from fragprune_plugins.adapting import NEAR, HostCall
from fragprune_plugins.learning.losses import WINDOW, ssim_map

_TAKEN = (*ARGUMENTS, "dc")
_SIGNATURE = Signature(
    [
        *(Parameter(each, Parameter.POSITIONAL_OR_KEYWORD) for each in ("self", *_TAKEN[:3])),
        *(Parameter(each, Parameter.POSITIONAL_OR_KEYWORD, default=None) for each in _TAKEN[3:]),
        Parameter("more", Parameter.VAR_KEYWORD),
    ]
)


def rasterizer(
    package: str,
    settings: tuple[str, ...],
    draw: Callable[[HostCall], Any],
    also: tuple[str, ...] = (),
) -> ModuleType:
    """The rasterizer package: settings, rasterizer and MCMC's relocation.

    It has no SparseGaussianAdam, which hosts since October 2024 look for: they do without. Methods
    ``also`` are called like ``forward``.
    """
    fields = [(name, Any) for name in settings]
    settings_type = NamedTuple("GaussianRasterizationSettings", fields)  # type: ignore[misc]

    class GaussianRasterizer(nn.Module):
        """Stand-in of fragprune for the compiled rasterizer."""

        def __init__(self, raster_settings: Any, **more: Any) -> None:
            super().__init__()
            self.raster_settings, self.more = raster_settings, more

        def markVisible(self, positions: Tensor) -> Tensor:  # noqa: N802 - the host's name
            """(P,) bool: in front of the near plane."""
            viewmatrix = self.raster_settings.viewmatrix
            depth = positions.detach() @ viewmatrix[:3, 2] + viewmatrix[3, 2]
            visible: Tensor = depth > NEAR
            return visible

    def entry(name: str) -> Callable[..., Any]:
        def call(self: GaussianRasterizer, *given: Any, **named: Any) -> Any:
            """Draw; see the adapter's dialect for what comes back."""
            taken = dict(zip(_TAKEN, given, strict=False))
            arguments = dict.fromkeys(_TAKEN) | self.more | taken | named
            where = f"{package}:GaussianRasterizer.{name}"
            return draw(HostCall(self.raster_settings, arguments, where))

        vars(call)["__signature__"] = _SIGNATURE
        return call

    for name in ("forward", *also):
        setattr(GaussianRasterizer, name, entry(name))

    return module(
        package,
        GaussianRasterizationSettings=settings_type,
        GaussianRasterizer=GaussianRasterizer,
        compute_relocation=compute_relocation,
    )


def module(name: str, **members: Any) -> ModuleType:
    """A stand-in under an import name."""
    made = ModuleType(name, "Stand-in of fragprune for a compiled module.")
    vars(made).update(members)
    return made


def simple_knn() -> dict[str, ModuleType]:
    """``simple_knn._C.distCUDA2``."""
    extension = module("simple_knn._C", distCUDA2=mean_squared_neighbour_distance)
    package = module("simple_knn", __path__=[], _C=extension)
    return {"simple_knn": package, "simple_knn._C": extension}


def mean_squared_neighbour_distance(points: Tensor) -> Tensor:
    """(N, 3) -> (N,) mean of the squared distances to the three nearest other points.

    Fewer neighbours are averaged as they are; a lone point gives 0.
    """
    from scipy.spatial import cKDTree

    cloud = points.detach().cpu().double().numpy()
    neighbours = min(4, len(cloud))
    if neighbours < 2:
        return torch.zeros(len(cloud), device=points.device)
    distances, _ = cKDTree(cloud).query(cloud, k=neighbours)
    mean = np.square(distances[:, 1:]).mean(axis=1)
    return torch.from_numpy(mean).float().to(points.device)


def compute_relocation(
    opacity_old: Tensor,
    scale_old: Tensor,
    N: Tensor,
    binoms: Tensor | None,
    n_max: int,
    bounds: tuple[float, float] = (0.0, 1.0),
) -> tuple[Tensor, Tensor]:
    """N equal Gaussians in place of one, such that together they look like it (3DGS-MCMC, eq. 9).

    At the centre ``1 - (1 - o)^N`` must be the old opacity, which gives o. The widths then make the
    integrals of ``1 - (1 - o g)^N`` and of ``o_old g_old`` along a line agree; expanded, the former
    is the width times the sum over j of ``C(N, j) (-1)^(j-1) o^j / sqrt(j)``.

    Args:
        opacity_old: (P,) activated.
        scale_old: (P, 3) activated.
        N: (P,) integers in [1, n_max).
        binoms: the caller's table of binomials, unused: in single precision it is too coarse.
        n_max: bound of N.
        bounds: of the new opacity, before it gives the scales.

    Returns:
        The opacity (P,) and the scales, flat (3 P,), of each of the N Gaussians.
    """
    total, old = N.long(), opacity_old.double()
    opacity = (-torch.expm1(torch.log1p(-old) / total)).clamp(*bounds)
    j = torch.arange(1, n_max, device=old.device)
    table = torch.tensor(
        [
            [math.comb(n, k) * (-1) ** (k - 1) / math.sqrt(k) for k in range(1, n_max)]
            for n in range(n_max)
        ],
        dtype=torch.float64,
        device=old.device,
    )
    width = (table[total] * opacity[:, None] ** j).sum(dim=1)
    scale = scale_old.double() * (old / width)[:, None]
    return opacity.to(opacity_old), scale.to(scale_old).reshape(-1)


def fused_ssim() -> dict[str, ModuleType]:
    """``fused_ssim.fused_ssim``, which hosts of 2024 and later import for their loss."""

    def similarity(img1: Tensor, img2: Tensor, padding: str = "same", train: bool = True) -> Tensor:
        """Mean SSIM of images (B, C, H, W); "valid" leaves out pixels near the border."""
        values = torch.stack([ssim_map(*pair) for pair in zip(img1, img2, strict=True)])
        border = WINDOW // 2
        return (
            values[..., border:-border, border:-border] if padding == "valid" else values
        ).mean()

    return {"fused_ssim": module("fused_ssim", fused_ssim=similarity)}
