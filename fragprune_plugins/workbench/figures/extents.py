"""How far Gaussians are drawn, as data: the rules of viewers, and cuts that nobody trained."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import Literal

import torch
from torch import Tensor

from fragprune_plugins.constants import ALPHA_MIN, TILE
from fragprune_plugins.engines import Engine
from fragprune_plugins.learning.area import project
from fragprune_plugins.types import RasterInputs, RasterOutputs, Splats


@dataclass(frozen=True)
class Extent:
    """A rule for the radius of an ellipse, in standard deviations."""

    name: str
    sigmas: float = math.inf  # the largest radius
    alpha: float = 0.0  # an ellipse ends where its alpha falls below this; 0 for however faint

    def squared(self, opacities: Tensor) -> Tensor:
        """(N,) squared radii of Gaussians of these opacities; negative where nothing is drawn."""
        most = torch.full_like(opacities, self.sigmas**2)
        return most.minimum(2 * (opacities / self.alpha).log()) if self.alpha else most

    def thresholds(self, opacities: Tensor) -> Tensor:
        """(N,) falloff at the rim; 1 where nothing is drawn."""
        return (-self.squared(opacities) / 2).exp().clamp(max=1.0)


CUTS = (
    Extent("alpha below 2/255", alpha=2 / 255),
    Extent("alpha below 4/255", alpha=4 / 255),
    Extent("alpha below 8/255", alpha=8 / 255),
    Extent("beyond 3 sigma", sigmas=3.0),
    Extent("beyond 2 sigma", sigmas=2.0),
)
"""What can be left out of any splat without learning: all alike, whatever is lost."""


@dataclass(frozen=True)
class Viewer:
    """How some viewers draw a Gaussian."""

    names: str
    extent: Extent  # the ellipse that they fill
    shape: Literal["quad", "square", "box"] = "quad"
    """What they rasterize for it: a quad around its axes, the tiles of a square of the longer axis,
    or those of its bounding box."""


SQRT8 = Extent("quads of √8 sigma", sigmas=math.sqrt(8))
_SIGMAS_OF_255 = math.sqrt(2 * math.log(255))  # at which an opaque Gaussian's alpha is 1/255

VIEWERS = (
    Viewer("antimatter15/splat, GaussianSplats3D, Spark, Babylon.js", SQRT8),
    Viewer("PlayCanvas", Extent("quads of √8 sigma, 1/255", math.sqrt(8), ALPHA_MIN)),
    Viewer("three.js GaussianSplatMesh", Extent("quads of 2 sigma", sigmas=2.0)),
    Viewer("3DGS reference (CUDA)", Extent("tiles of a 3 sigma square", sigmas=3.0), "square"),
    Viewer("gsplat 1.5", Extent("tiles of a box, 1/255", _SIGMAS_OF_255, ALPHA_MIN), "box"),
)
"""The rules of viewers, read from their sources in 2026.

antimatter15/splat ``main.js``: axes sqrt(2 lambda), corners +-2. GaussianSplats3D
``SplatMaterial3D.js``: ``sqrt8``. Spark 2.1 ``splatVertex.glsl``: ``maxStdDev``, sqrt(8) unless
set. Babylon.js ``gaussianSplatting.fx``: as antimatter15. PlayCanvas 2.22 ``gsplatCommon.js``:
``clipCorner`` shrinks by the opacity. three.js ``GaussianSplatMesh``: corners +-2 of sqrt(lambda).
3DGS ``forward.cu``: ``ceil(3 sqrt(lambda))``, ``getRect``. gsplat 1.5.3: radii follow the opacity.
"""


def covered(engine: Engine, inputs: RasterInputs, squared: Tensor) -> RasterOutputs:
    """Draw so that fragments count all pixels in the Gaussians' ellipses, hidden ones too.

    Their radii have squares (N,), negative for none; engines look no farther than 3.33 sigma.
    """
    # Alpha capped at its least hides nothing; see ``visible``. A threshold then ends each ellipse.
    assert isinstance(inputs.splats, Splats)
    opaque = replace(inputs.splats, opacities=torch.ones_like(inputs.splats.opacities))
    inputs = replace(inputs, splats=opaque, compensation="none", alpha_max=ALPHA_MIN)
    inputs = replace(inputs, stop=None, rim="hard")
    return engine.rasterize(inputs, (-squared / 2).exp().clamp(max=1.0))


def quads(engine: Engine, inputs: RasterInputs, squared: Tensor) -> float:
    """Pixels of quads around such ellipses: 4 / pi times theirs, over those of the picture."""
    return 4 / math.pi * float(covered(engine, inputs, squared).fragments_per_pixel)


def shaded(engine: Engine, inputs: RasterInputs, viewer: Viewer) -> float:
    """Pixels that a viewer is asked to shade, over the picture's; of tiles also those spared."""
    assert isinstance(inputs.splats, Splats)
    squared = viewer.extent.squared(inputs.splats.opacities)
    if viewer.shape == "quad":
        return quads(engine, inputs, squared)
    (xx, xy, yy), means2d, visible = project(inputs, inputs.splats)
    if viewer.shape == "square":
        middle = (xx + yy) / 2
        longer = middle + (middle * middle - (xx * yy - xy * xy)).clamp_min(0.1).sqrt()
        half = (squared * longer).clamp_min(0).sqrt().ceil()[:, None].expand(-1, 2)
    else:
        half = (squared.clamp_min(0)[:, None] * torch.stack([xx, yy], 1)).sqrt().ceil()
    size = means2d.new_tensor([inputs.view.width, inputs.view.height])
    grid = (size / TILE).ceil()
    first = ((means2d - half) / TILE).floor().clamp_min(0).minimum(grid)
    # 3DGS adds 15 pixels and rounds down (``getRect``), gsplat rounds up.
    end = (means2d + half) / TILE
    last = (end + 1 - 1 / TILE).floor() if viewer.shape == "square" else end.ceil()
    last = last.clamp_min(0).minimum(grid)
    tiles = (last - first).clamp_min(0).prod(1)
    pairs = float(torch.where(visible & (squared >= 0), tiles, 0.0).double().sum())
    return pairs * TILE * TILE / float(size.prod())
