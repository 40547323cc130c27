"""Scenes as footprints: the same picture, projected in torch before any engine sees it."""

from dataclasses import replace

import torch
from torch import Tensor

from fragprune_plugins.engines.reference import camera_of, gaussians_of, options_of
from fragprune_plugins.types import Footprints, RasterInputs
from reference_renderer import project


def footprints_of(inputs: RasterInputs) -> RasterInputs:
    """Row by row, culled ones without tiles; gradients reach the splats."""
    camera, options = camera_of(inputs), options_of(inputs)
    gaussians, n = gaussians_of(inputs.splats), len(inputs.splats)
    front = project.rows_in_front(camera, gaussians.means, options.near)
    found = project.project(camera, gaussians.take(front), options)
    rects = torch.where(found.radius[:, None] > 0, project.tile_rects(camera, found), 0)

    def spread(rows: Tensor) -> Tensor:
        return rows.new_zeros(n, *rows.shape[1:]).index_copy(0, front, rows)

    prints = Footprints(
        means2d=spread(found.mean2d),
        conics=spread(found.conic),
        depths=spread(found.depth),
        opacities=spread(found.opacity),
        colors=spread(found.color),
        tiles=spread(rects.to(torch.int32)),
        features=None if found.features is None else spread(found.features),
    )
    return replace(inputs, splats=prints)
