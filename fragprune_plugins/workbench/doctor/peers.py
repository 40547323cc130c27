"""Other rasterizers that are installed here, as engines that draw without thresholds.

Each is called as its own documentation says. They run on a GPU only, and do not count fragments.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from importlib import import_module
from importlib.util import find_spec
from typing import Any

import torch
from torch import Tensor

from fragprune_plugins.errors import EngineError
from fragprune_plugins.types import RasterInputs, RasterOutputs, Splats
from fragprune_plugins.workbench.doctor.work import package_version

Draw = Callable[[RasterInputs, Splats], tuple[Tensor, Tensor]]  # picture (3, H, W), radii (N,)


@dataclass
class Peer:
    """Another rasterizer as an engine."""

    name: str  # of its package
    draw: Draw

    def rasterize(self, inputs: RasterInputs, thresholds: Tensor | None) -> RasterOutputs:
        """Draw the splats; raises EngineError with thresholds, which it does not know."""
        if thresholds is not None or not isinstance(inputs.splats, Splats):
            where, expected = f"engine '{self.name}'", "Gaussians without any"
            raise EngineError(where, "thresholds", expected, "Leave them out.")
        image, radii = self.draw(inputs, inputs.splats)
        return RasterOutputs(
            image=image,
            radii=radii,
            invdepth=image[:0],
            alpha=image[:0],
            fragments_per_pixel=image.new_tensor(math.nan),
            evaluated_per_pixel=math.nan,
        )


def installed() -> dict[str, str]:
    """The packages of peers that are here, with their versions."""
    return {name: package_version(name) or "unknown" for name in PEERS if find_spec(name)}


def peer(name: str) -> Peer:
    """An installed peer."""
    return Peer(name, PEERS[name])


def _hosts(inputs: RasterInputs, splats: Splats) -> tuple[Tensor, Tensor]:
    """The rasterizer of 3DGS and its descendants; its settings grew over the years."""
    module = import_module("diff_gaussian_rasterization")
    view, kind = inputs.view, module.GaussianRasterizationSettings
    known: dict[str, Any] = {
        "image_height": view.height,
        "image_width": view.width,
        "tanfovx": view.tan_fov_x,
        "tanfovy": view.tan_fov_y,
        "bg": view.background,
        "scale_modifier": inputs.scale_modifier,
        "viewmatrix": view.viewmatrix,
        "projmatrix": view.projmatrix,
        "sh_degree": splats.sh_degree,
        "campos": view.campos,
        "prefiltered": False,
        "debug": False,
        "antialiasing": False,
    }
    if foreign := set(kind._fields) - known.keys():
        found = f"settings {', '.join(sorted(foreign))}"
        remedy = "It is another rasterizer by the same name: nothing to compare with."
        raise EngineError("engine 'diff_gaussian_rasterization'", found, "those of 3DGS", remedy)
    settings = kind(**{name: known[name] for name in kind._fields})
    hook = inputs.means2d_hook
    image, radii, *_ = module.GaussianRasterizer(settings)(
        means3D=splats.means,
        means2D=torch.zeros_like(splats.means) if hook is None else hook,
        opacities=splats.opacities[:, None],
        shs=splats.sh,
        scales=splats.scales,
        rotations=splats.rotations,
    )
    return image, radii


def _gsplat(inputs: RasterInputs, splats: Splats) -> tuple[Tensor, Tensor]:
    """gsplat's ``rasterization`` in its classic mode, with the hosts' near plane."""
    view = inputs.view
    x, y = view.width / 2, view.height / 2
    lens = [[x / view.tan_fov_x, 0.0, x], [0.0, y / view.tan_fov_y, y], [0.0, 0.0, 1.0]]
    images, _, meta = import_module("gsplat").rasterization(
        means=splats.means,
        quats=splats.rotations,
        scales=splats.scales,
        opacities=splats.opacities,
        colors=splats.sh,
        viewmats=view.viewmatrix.T[None],
        Ks=torch.tensor([lens], device=splats.device),
        width=view.width,
        height=view.height,
        near_plane=inputs.near,
        eps2d=inputs.dilation,
        sh_degree=splats.sh_degree,
        packed=False,
        backgrounds=view.background[None],
    )
    radii = meta["radii"][0]
    return images[0].permute(2, 0, 1), radii if radii.ndim == 1 else radii.amax(1)


PEERS: dict[str, Draw] = {"diff_gaussian_rasterization": _hosts, "gsplat": _gsplat}
"""By the name of the package: how it draws."""
