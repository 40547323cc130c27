"""A rasterizer that stands for a host's compiled one: the oracle, with one difference built in."""

from collections.abc import Callable
from contextlib import AbstractContextManager, nullcontext
from dataclasses import dataclass, replace
from typing import Any, NamedTuple
from unittest import mock

import torch
from torch import Tensor, nn

from fragprune_graphdeco.call import SHARED
from reference_renderer import Camera, Gaussians, Options, Rendering, project, render
from reference_renderer import covariance as covariances
from reference_renderer import fragment as fragments
from reference_renderer.sh import sh_basis

PACKAGE = "diff_gaussian_rasterization"


class _Changed(torch.autograd.Function):
    """The tensor itself; its gradient goes through a function of gradient and tensor."""

    @staticmethod
    def forward(ctx: Any, tensor: Tensor, change: Callable[..., Tensor]) -> Tensor:
        ctx.save_for_backward(tensor)
        ctx.change = change
        return tensor.view_as(tensor)

    @staticmethod
    def backward(ctx: Any, *grads: Tensor) -> tuple[Tensor, None]:
        return ctx.change(grads[0], *ctx.saved_tensors), None


@dataclass(frozen=True)
class Difference:
    """What a rasterizer does otherwise.

    Attributes:
        options: of the oracle.
        patched: replaces functions of the oracle while it draws.
        backward: by an argument's name, the gradient (N, ...) from the right one and the argument.
        radii: divides them.
        also: further outputs, of a rendering whose feature is the view depth.
        weighed: a further output, of the weights (N, H, W) of all Gaussians, and of these.
        lit: whether the background shines through.
    """

    options: dict[str, Any] | None = None
    patched: Callable[[], AbstractContextManager[Any]] = nullcontext
    backward: dict[str, Callable[[Tensor, Tensor], Tensor]] | None = None
    radii: int = 1
    also: tuple[Callable[[Rendering], Tensor], ...] = ()
    weighed: Callable[[Tensor, Gaussians, Camera], Tensor] | None = None
    lit: bool = True


def straight(camera: Camera, points: Tensor) -> Tensor:
    """A projection along each ray's own direction, not along the camera's axis."""
    distance = points.norm(dim=1)[:, None, None] / points[:, 2, None, None]
    return _jacobians(camera, points) / distance


def steeper(*given: Tensor) -> Tensor:
    """Distances for a falloff with another exponent."""
    return _squared_distances(*given) ** 1.1


def unclamped(means: Tensor, campos: Tensor, sh: Tensor, degree: int) -> Tensor:
    """Colours as the oracle's, but not clamped at 0."""
    basis = sh_basis(torch.nn.functional.normalize(means - campos, dim=-1), degree)
    return (basis[:, :, None] * sh[:, : basis.shape[1]]).sum(dim=1) + 0.5


def view_depths(gaussians: Gaussians, camera: Camera) -> Tensor:
    """(N,) z in view space."""
    return (gaussians.means @ camera.viewmatrix[:3, 2] + camera.viewmatrix[3, 2]).detach()


def median_depth(weights: Tensor, gaussians: Gaussians, camera: Camera) -> Tensor:
    """z of the first fragment, front to back, behind which less than half of the light is left."""
    depths, order = view_depths(gaussians, camera).sort()
    dark = 1 - weights.detach()[order].cumsum(0) < 0.5
    return torch.where(dark.any(0), depths[dark.int().argmax(0)], 0.0)


def heaviest_depth(weights: Tensor, gaussians: Gaussians, camera: Camera) -> Tensor:
    """z of the Gaussian of largest weight."""
    best, rows = weights.detach().max(0)
    return torch.where(best > 0, view_depths(gaussians, camera)[rows], 0.0)


def normals(*signs: float) -> Callable[[Tensor, Gaussians, Camera], Tensor]:
    """Sums of the shortest axes, in the world or with these signs in view space."""

    def blended(weights: Tensor, gaussians: Gaussians, camera: Camera) -> Tensor:
        turned = covariances.rotation_matrices(gaussians.rotations)
        rows = torch.arange(len(turned))
        axes = turned[rows, :, gaussians.scales.argmin(1)]
        facing = (camera.campos - gaussians.means).mul(axes).sum(1).sign()
        axes = axes * facing[:, None]
        if signs:
            axes = axes @ camera.viewmatrix[:3, :3] * torch.tensor(signs)
        return torch.einsum("nhw,nc->chw", weights, axes).detach()

    return blended


_jacobians, _squared_distances = covariances.jacobians, fragments.squared_distances

DIFFERENCES = {
    "none": Difference(),
    "projection": Difference(patched=lambda: mock.patch.object(covariances, "jacobians", straight)),
    "dilation": Difference({"dilation": 0.1}),
    "exponent": Difference(
        patched=lambda: mock.patch.object(fragments, "squared_distances", steeper)
    ),
    "alpha's cap": Difference({"alpha_max": 0.999}),
    "faint fragments": Difference({"alpha_min": 1 / 64}),
    "stop": Difference({"transmittance_min": 1e-3}),
    "scale modifier": Difference({"scale_modifier": 1.0}),
    "near plane": Difference({"near": 0.01}),
    "colours below 0": Difference(
        patched=lambda: mock.patch.object(project, "sh_colors", unclamped)
    ),
    "absolute gradient": Difference({"absolute_gradient": True}),
    "gradient by pixels": Difference(backward={"means2D": lambda grad, _: 0.9 * grad}),
    "frozen positions": Difference(backward={"means3D": lambda grad, _: 0 * grad}),
    "regularised scales": Difference(backward={"scales": lambda grad, own: grad + 0.5 * own}),
    "straight-through opacities": Difference(
        backward={"opacities": lambda grad, own: grad * own * (1 - own)}
    ),
    "half the radii": Difference(radii=2),
    "no background": Difference(lit=False),
    "depth": Difference(also=(lambda drawn: drawn.features,)),
    "depth without gradient": Difference(also=(lambda drawn: drawn.features.detach(),)),
    "depth over alpha": Difference(
        also=(lambda d: torch.where(d.alpha > 0, d.features / d.alpha.clamp(min=1e-12), 0.0),)
    ),
    "inverse depth": Difference(also=(lambda drawn: drawn.invdepth,)),
    "alpha": Difference(also=(lambda drawn: drawn.alpha[0],)),
    "median depth": Difference(weighed=median_depth),
    "largest weight": Difference(weighed=heaviest_depth),
    "normals": Difference(weighed=normals()),
    "normals in view space": Difference(weighed=normals(1, 1, 1)),
    "normals, y up": Difference(weighed=normals(1, -1, -1)),
    "unknown": Difference(also=(lambda drawn: drawn.features.sqrt(),)),
    "constant": Difference(also=(lambda drawn: torch.zeros_like(drawn.alpha),)),
}

Settings = NamedTuple("Settings", [(name, Any) for name in (*SHARED, "antialiasing")])
Settings.__new__.__defaults__ = (False,)


class Rasterizer(nn.Module):
    """The class that hosts import; ``difference`` is set by the package's file."""

    difference = DIFFERENCES["none"]

    def __init__(self, raster_settings: Any) -> None:
        super().__init__()
        self.raster_settings = raster_settings

    def forward(
        self,
        means3D: Tensor,
        means2D: Tensor,
        opacities: Tensor,
        shs: Tensor | None = None,
        colors_precomp: Tensor | None = None,
        scales: Tensor | None = None,
        rotations: Tensor | None = None,
        cov3D_precomp: Tensor | None = None,
    ) -> tuple[Tensor, ...]:
        """(colour (3, H, W), radii (N,), and what the difference adds)."""
        s, other = self.raster_settings, self.difference
        given = {"means3D": means3D, "means2D": means2D, "opacities": opacities, "scales": scales}
        if s.antialiasing:  # vanilla's backward pass
            given["scales"] = _Changed.apply(scales, lambda grad, own: 1.1 * grad)
        for name, change in (other.backward or {}).items():
            given[name] = _Changed.apply(given[name], change)
        camera = Camera(
            width=s.image_width,
            height=s.image_height,
            tan_fov_x=s.tanfovx,
            tan_fov_y=s.tanfovy,
            viewmatrix=s.viewmatrix,
            projmatrix=s.projmatrix,
            campos=s.campos,
            background=s.bg if other.lit else torch.zeros(3),
        )
        means = given["means3D"]
        gaussians = Gaussians(
            means=means,
            opacities=given["opacities"][:, 0],
            scales=given["scales"],
            rotations=rotations,
            cov3d=cov3D_precomp,
            sh=shs,
            colors=colors_precomp,
            sh_degree=s.sh_degree,
            features=means @ s.viewmatrix[:3, 2:3] + s.viewmatrix[3, 2],
        )
        own = {"compensation": "antialiasing" if s.antialiasing else "none"}
        own["scale_modifier"] = s.scale_modifier
        options = Options(**own | (other.options or {}))
        with other.patched():
            drawn = render(camera, gaussians, means2d_hook=given["means2D"], options=options)
            also = [of(drawn) for of in other.also]
            if other.weighed is not None:
                rows = replace(gaussians, features=torch.eye(len(means)))
                weights = render(camera, rows, options=options).features
                also.append(other.weighed(weights, gaussians, camera))
        return drawn.image, drawn.radii // other.radii, *also


def write(folder: Any, difference: str) -> None:
    """Write the package of a rasterizer with a difference into a host's folder."""
    package = folder / PACKAGE
    package.mkdir()
    (package / "__init__.py").write_text(
        "from miniatures import compiled\n\n"
        "GaussianRasterizationSettings = compiled.Settings\n\n\n"
        "class GaussianRasterizer(compiled.Rasterizer):\n"
        f"    difference = compiled.DIFFERENCES[{difference!r}]\n\n"
        "    def forward(self, means3D, means2D, opacities, shs=None, colors_precomp=None,\n"
        "                scales=None, rotations=None, cov3D_precomp=None):\n"
        "        return super().forward(means3D, means2D, opacities, shs, colors_precomp, scales,\n"
        "                               rotations, cov3D_precomp)\n"
    )
