"""autonomousvision/mip-splatting: 3DGS without aliasing, by a 3D filter and a 2D one.

The 3D filter widens every Gaussian to what the closest training camera can resolve and dims it
accordingly; it is recomputed from positions and cameras and lives in the PLY alone. The 2D filter
is the rasterizer's: a dilation of ``kernel_size`` whose gain in area is taken back from the
opacity. Densification also follows the absolute gradients on the screen.
"""

from __future__ import annotations

from argparse import ArgumentParser
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any

import fragprune_graphdeco as graphdeco
from fragprune_3dgs_fork.holding import HoldingAdapter
from fragprune_graphdeco import GraphdecoAdapter, GraphdecoDialect, RasterizerCall, model_seam
from fragprune_plugins.adapting import HostCall, HostInfo, HostRepo, RasterInputs, Role

if TYPE_CHECKING:
    from torch import Tensor

KERNEL_SIZE = 0.1


@dataclass(frozen=True)
class MipDialect(GraphdecoDialect):
    """Vanilla's call of 2023 with the 2D filter's size and a sampling offset for each pixel."""

    unneeded = {"open3d": {}, "cv2": {}}  # imported and never used

    def unpack(self, call: HostCall) -> RasterInputs:
        """Translate the call; densification reads an absolute third column of the gradient."""
        return replace(
            super().unpack(call),
            dilation=float(call.settings.kernel_size),
            compensation="mip",
            sample_offsets=call.settings.subpixel_offset,
            absolute_gradient=True,
        )


class MipSplatting(HoldingAdapter):
    """The adapter of Mip-Splatting."""

    name = "mip-splatting"
    descends_from = ("vanilla-3dgs",)
    info = HostInfo(
        "Mip-Splatting",
        repo="autonomousvision/mip-splatting",
        states="2024, with absolute gradients in densification",
        limits=(
            "fragprune finetune, render and compare take create_fused_ply.py's PLY, not its own.",
        ),
    )
    calls = (RasterizerCall(frozenset({"kernel_size", "subpixel_offset"})),)
    drawn_from = ("get_opacity_with_3D_filter", "get_scaling_with_3D_filter")
    own_names = ("compute_3D_filter", "get_opacity_with_3D_filter", "filter_3D")
    dialect_type = MipDialect
    filtered = True
    undrawn_flags = (*GraphdecoAdapter.undrawn_flags, "--load_allres")
    seams = (*GraphdecoAdapter.seams, model_seam(Role.SAVE, "save_fused_ply", "path"))

    def opacities(self, model: Any) -> Tensor:
        """(N,) as they are drawn: dimmed by the 3D filter."""
        opacities: Tensor = model.get_opacity_with_3D_filter
        return opacities.detach().reshape(-1)

    def drawing(self, repo: HostRepo, arguments: list[str]) -> dict[str, Any]:
        """The command's 2D filter, or the default."""
        parser = ArgumentParser(add_help=False)
        size = graphdeco.default(repo, "_kernel_size", KERNEL_SIZE)
        parser.add_argument("-k", "--kernel_size", type=float, default=size)
        size = parser.parse_known_args(arguments)[0].kernel_size
        return super().drawing(repo, arguments) | {"dilation": size, "compensation": "mip"}
