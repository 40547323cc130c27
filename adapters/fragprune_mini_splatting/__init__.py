"""fatPeter/mini-splatting: few Gaussians, placed anew from depth and sampled by importance.

Its training scripts have their own folders, gs, ms and ms_d. At every call its functions import one
of two rasterizers: vanilla's, or one that also scores every Gaussian by its part of the picture and
finds where rays meet Gaussians. New points, simplification and splitting follow these scores. With
thresholds the scores count only fragments that remain after truncation.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from types import ModuleType
from typing import TYPE_CHECKING, Any

import fragprune_graphdeco as graphdeco
from fragprune_3dgs_fork.holding import HoldingAdapter
from fragprune_graphdeco import GraphdecoAdapter, GraphdecoDialect, RasterizerCall, model_seam
from fragprune_plugins.adapting import (
    HostCall,
    HostInfo,
    RasterInputs,
    RasterOutputs,
    Role,
    Seam,
    SeamCall,
)

if TYPE_CHECKING:
    from torch import Tensor


RENDERER = "gaussian_renderer"
SCORING = "diff_gaussian_rasterization_ms"
DEPTH = "GaussianRasterizer.render_depth"
COMPRESSED = "compressed_gs.npz"
SCRIPTS = ("ms/train.py", "ms_d/train.py", "gs/train.py")


@dataclass(frozen=True)
class MiniSplattingDialect(GraphdecoDialect):
    """Vanilla's call of 2023 in one package, and with scores or depth in the other."""

    def values(self, call: HostCall) -> tuple[str, ...]:
        """Colour and radii; of the scoring rasterizer, three numbers of each Gaussian more."""
        scores = ("weight", "count", "wins") if call.entry.startswith(SCORING) else ()
        return (*super().values(call), *scores)

    def answer(
        self, call: HostCall, inputs: RasterInputs, draw: Callable[[RasterInputs], RasterOutputs]
    ) -> Any:
        """Draw and pack; ``render_depth`` draws some pixels again."""
        if not call.entry.endswith(DEPTH):
            return super().answer(call, inputs, draw)
        from fragprune_mini_splatting.depth import render_depth

        return render_depth(inputs, draw)

    def names(self) -> frozenset[str]:
        """The import names of vanilla's packages and of the scoring rasterizer."""
        return super().names() | {SCORING}

    def modules(self, draw: Callable[[HostCall], Any]) -> dict[str, ModuleType]:
        """Stand-ins for vanilla's packages and for the scoring rasterizer."""
        from fragprune_graphdeco import stand_ins

        scoring = stand_ins.rasterizer(SCORING, self.settings, draw, also=("render_depth",))
        return {**super().modules(draw), SCORING: scoring}


def packed(call: SeamCall) -> tuple[Path, Tensor] | None:
    """The Gaussians that ms_c compresses: one for each voxel, sorted by position."""
    import torch

    path = Path(str(call.first))
    if path.name != COMPRESSED:
        return None
    given = call.arguments.get("args")
    return path, torch.from_numpy(given[0] if given else call.result["arr_0"])


class MiniSplatting(HoldingAdapter):
    """The adapter of Mini-Splatting and Mini-Splatting-D."""

    name = "mini-splatting"
    descends_from = ("vanilla-3dgs",)
    info = HostInfo(
        "Mini-Splatting",
        repo="fatPeter/mini-splatting",
        states="gs, ms, ms_d and ms_c",
        limits=("--compute_cov3D_python is refused where the host asks for depth (ms, ms_d).",),
    )
    calls = (
        RasterizerCall(),
        RasterizerCall(outputs=5, function="render_imp", package=SCORING),
        RasterizerCall(outputs=None, function="render_depth", package=SCORING),
    )
    dialect_type = MiniSplattingDialect
    scripts = SCRIPTS
    densifies_until = ("densify_until_iter", "simp_iteration1", "simp_iteration2")
    seams = (
        *GraphdecoAdapter.seams,
        Seam(Role.VIEW, RENDERER, "render_imp", ("viewpoint_camera", "pc")),
        Seam(Role.VIEW, RENDERER, "render_depth", ("viewpoint_camera", "pc")),
        graphdeco.rasterizer_seam(SCORING),
        graphdeco.rasterizer_seam(SCORING, "render_depth"),
        model_seam(Role.STILL, "densify_and_prune_split"),
        model_seam(Role.STILL, "prune_points", "mask"),
        model_seam(Role.STILL, "reinitial_pts", "pts", "rgb"),
        Seam(Role.METRIC, "lpipsPyTorch", "lpips"),
        Seam(Role.PACK, "numpy", "savez_compressed", ("file", "args"), external=True, how=packed),
        Seam(Role.UNPACK, "numpy", "load", ("file",), external=True, how=packed),
    )
