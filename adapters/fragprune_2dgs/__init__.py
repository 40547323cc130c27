"""hbb1/2d-gaussian-splatting: flat Gaussians (surfels) that lie on the surface.

A pixel's ray meets a surfel in the surfel's plane, and the falloff is that of the point there. A
threshold acts on this falloff. The rasterizer also draws depths, normals and a distortion, from
which the host regularises.
"""

from __future__ import annotations

import ast
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import fragprune_graphdeco as graphdeco
from fragprune_3dgs_fork.holding import HoldingAdapter
from fragprune_graphdeco import GraphdecoAdapter, GraphdecoDialect, RasterizerCall, every, text_of
from fragprune_plugins.adapting import (
    Finding,
    HostCall,
    HostInfo,
    HostRepo,
    InputError,
    RasterInputs,
    RasterOutputs,
    revised,
)

if TYPE_CHECKING:
    from torch import Tensor

PACKAGE = "diff_surfel_rasterization"
RENDERER, MAPS = "gaussian_renderer", 7


@dataclass(frozen=True)
class SurfelDialect(GraphdecoDialect):
    """Vanilla's call of 2023 with two scales; a stack of seven maps comes third."""

    def unpack(self, call: HostCall) -> RasterInputs:
        """Translate the call; InputError for matrices instead of scales and rotations."""
        if call.get("cov3D_precomp") is not None:
            found = "cov3D_precomp, the surfels' matrices, of which the host draws no normals"
            remedy = "Leave out --compute_cov3D_python."
            raise InputError("diff_surfel_rasterization", found, "scales and rotations", remedy)
        return replace(super().unpack(call), planes=("alpha", "surface"))

    def pack(self, outputs: RasterOutputs, call: HostCall) -> tuple[Tensor, ...]:
        """(colour (3, H, W), radii (P,) int32, maps (7, H, W)).

        The maps: depth, alpha, normal (3), median depth, distortion. The host divides the first by
        the second, so its gradient is NaN where nothing is drawn. No fragment of its own rasterizer
        reads it there, but fragments just beyond a threshold would.
        """
        import torch

        surface = outputs.surface
        assert surface is not None  # unpack asked for it
        maps = torch.cat([surface[:1], outputs.alpha, surface[1:]])
        return outputs.image, outputs.radii, torch.where(outputs.alpha > 0, maps, 0.0)


class SurfelSplatting(HoldingAdapter):
    """The adapter of 2D Gaussian Splatting."""

    name = "2dgs"
    descends_from = ("vanilla-3dgs",)
    info = HostInfo(
        "2D Gaussian Splatting",
        repo="hbb1/2d-gaussian-splatting",
        states="July 2025",
        limits=(
            "A GPU cannot draw with thresholds: stage 2 needs --device cpu.",
            "fragprune finetune, view, export and audit have no surfels: they refuse its PLY.",
            "--portable and --compute_cov3D_python are refused.",
        ),
    )
    package = PACKAGE
    kernel = graphdeco.SURFEL
    on_gpu = False
    filtered = True
    calls = (RasterizerCall(outputs=3),)
    own_names = ("utils.point_utils:depth_to_normal", "gaussian_renderer:allmap")
    dialect_type = SurfelDialect
    seams = revised(GraphdecoAdapter.seams, {"GaussianRasterizer.forward": {"module": PACKAGE}})

    def fingerprint(self, repo: HostRepo) -> list[Finding]:
        """Likewise, and an error for a drawing that reads further maps, which nobody draws here."""
        found, drawing = super().fingerprint(repo), repo.function(RENDERER, "render")
        for each in every(drawing, ast.Subscript):
            ends = [getattr(n, "value", 0) for n in every(each.slice, ast.Constant)]
            if text_of(each.value) == "allmap" and max(ends, default=0) > MAPS:
                at = f"{RENDERER}:render ({repo.at(RENDERER, each.lineno)})"
                what = f"reads {text_of(each)}"
                found.append(Finding.error("rasterizer-call", at, what, f"a stack of {MAPS} maps"))
        return found
