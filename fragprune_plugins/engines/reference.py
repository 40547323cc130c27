"""The oracle as an engine: slow, readable, on any device; what other engines are tested against."""

from __future__ import annotations

from typing import TYPE_CHECKING

from fragprune_plugins.types import RasterInputs, RasterOutputs
from reference_renderer import Camera, Gaussians, Options, render

if TYPE_CHECKING:
    from torch import Tensor


class ReferenceEngine:
    """Plain torch with autograd; the only place where core types meet the oracle's."""

    name = "reference"

    def rasterize(self, inputs: RasterInputs, thresholds: Tensor | None) -> RasterOutputs:
        """Draw the splats; thresholds is (N,) falloff in (0, 1), or None for no truncation."""
        drawn = render(
            camera_of(inputs),
            gaussians_of(inputs),
            thresholds,
            means2d_hook=inputs.means2d_hook,
            options=Options(
                scale_modifier=inputs.scale_modifier,
                dilation=inputs.dilation,
                antialiasing=inputs.antialiasing,
            ),
        )
        return RasterOutputs(
            image=drawn.image,
            radii=drawn.radii,
            invdepth=drawn.invdepth,
            alpha=drawn.alpha,
            fragments_per_pixel=drawn.fragments_per_pixel,
            evaluated_per_pixel=drawn.evaluated / (inputs.view.width * inputs.view.height),
            fragments=drawn.fragments if inputs.counts else None,
            fragments_per_gaussian=drawn.fragments_per_gaussian if inputs.counts else None,
        )


def camera_of(inputs: RasterInputs) -> Camera:
    """The oracle's camera."""
    view = inputs.view
    return Camera(
        width=view.width,
        height=view.height,
        tan_fov_x=view.tan_fov_x,
        tan_fov_y=view.tan_fov_y,
        viewmatrix=view.viewmatrix,
        projmatrix=view.projmatrix,
        campos=view.campos,
        background=view.background,
    )


def gaussians_of(inputs: RasterInputs) -> Gaussians:
    """The oracle's Gaussians, sharing the tensors."""
    splats = inputs.splats
    return Gaussians(
        means=splats.means,
        opacities=splats.opacities,
        scales=splats.scales,
        rotations=splats.rotations,
        cov3d=splats.cov3d,
        sh=splats.sh,
        colors=splats.colors,
        sh_degree=splats.sh_degree,
    )
