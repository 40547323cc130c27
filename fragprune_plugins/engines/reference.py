"""The oracle as an engine: slow, readable, on any device. Other engines are tested against it."""

from __future__ import annotations

from dataclasses import fields

import torch
from torch import Tensor

from fragprune_plugins.engines.calling import with_joined_sh
from fragprune_plugins.types import Footprints, RasterInputs, RasterOutputs, Splats
from reference_renderer import Camera, Gaussians, Options, Rendering, render, render_footprints
from reference_renderer import Footprints as Projected


class ReferenceEngine:
    """Rasterizes with plain torch and autograd, by converting core types to the oracle's."""

    name = "reference"

    def rasterize(self, inputs: RasterInputs, thresholds: Tensor | None) -> RasterOutputs:
        """Draw the splats; thresholds is (N,) falloff in (0, 1), or None for no truncation."""
        inputs.check_thresholds(thresholds)
        kind, pixels = inputs.splats.device.type, inputs.view.width * inputs.view.height
        with torch.autocast("cuda" if kind == "cuda" else "cpu", enabled=False):
            drawn = _draw(inputs, thresholds)  # compiled engines know no autocast either
        return RasterOutputs(
            image=drawn.image,
            radii=drawn.radii,
            invdepth=drawn.invdepth,
            alpha=drawn.alpha,
            fragments_per_pixel=drawn.fragments_per_pixel,
            evaluated_per_pixel=drawn.evaluated / pixels,
            entries_per_pixel=drawn.entries / pixels,
            fragments=drawn.fragments if inputs.counts else None,
            fragments_per_gaussian=drawn.fragments_per_gaussian if inputs.counts else None,
            features=drawn.features,
            weights_per_gaussian=drawn.weights_per_gaussian.float() if inputs.scores else None,
            wins_per_gaussian=drawn.wins_per_gaussian if inputs.scores else None,
            winners=drawn.winners if inputs.scores else None,
            surface=drawn.surface,
        )


def _draw(inputs: RasterInputs, thresholds: Tensor | None) -> Rendering:
    camera, hook, options = camera_of(inputs), inputs.means2d_hook, options_of(inputs)
    splats = inputs.splats
    if thresholds is not None:
        thresholds = thresholds.to(splats.opacities)  # type and device, as compiled engines do
    if isinstance(splats, Splats):
        gaussians = gaussians_of(splats)
        return render(camera, gaussians, thresholds, means2d_hook=hook, options=options)
    projected = projected_of(splats)
    return render_footprints(
        camera, projected, splats.tiles, thresholds, means2d_hook=hook, options=options
    )


def options_of(inputs: RasterInputs) -> Options:
    """The oracle's options for these inputs, which have the same names."""
    shared = {each.name for each in fields(Options)} & vars(inputs).keys()
    return Options(**{name: getattr(inputs, name) for name in shared})


def camera_of(inputs: RasterInputs) -> Camera:
    """The oracle's camera for these inputs."""
    return Camera(**vars(inputs.view))


def gaussians_of(splats: Splats) -> Gaussians:
    """The oracle's Gaussians, sharing the tensors."""
    given = vars(with_joined_sh(splats))
    return Gaussians(**{name: given[name] for name in given.keys() - {"sh_rest"}})


def projected_of(footprints: Footprints) -> Projected:
    """The oracle's footprints, sharing the tensors."""
    return Projected(
        mean2d=footprints.means2d,
        conic=footprints.conics,
        depth=footprints.depths,
        opacity=footprints.opacities,
        color=footprints.colors,
        radius=footprints.depths.new_zeros(len(footprints)),
        features=footprints.features,
    )
