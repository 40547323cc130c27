"""Small seeded scenes for tests of engines. Same seed, same scene, in every dtype, on every device.

Everything is drawn in float64 on the CPU from a generator of its own, then cast: a float32 and a
float64 engine see the same Gaussians up to rounding, and the global random stream is never touched.
"""

import math
from dataclasses import fields, replace
from typing import Any

import torch
from torch import Tensor

from fragprune_plugins.constants import NEUTRAL_LOGIT, TILE
from fragprune_plugins.engines.reference import ReferenceEngine, camera_of, gaussians_of, options_of
from fragprune_plugins.types import Footprints, RasterInputs, Splats, View
from reference_renderer import project
from reference_renderer.covariance import covariances, rotation_matrices

SH_DC = 0.28209479177387814
"""The constant spherical harmonic, 1 / (2 sqrt(pi))."""


def random_scene(
    seed: int,
    n: int = 60,
    width: int = 40,
    height: int = 28,
    *,
    sh_degree: int = 1,
    colors: bool = False,
    cov3d: bool = False,
    flat: bool = False,
    features: int = 0,
    offsets: bool = False,
    dtype: torch.dtype = torch.float32,
    device: torch.device | str = "cpu",
    **dialect: Any,
) -> RasterInputs:
    """Anisotropic splats of 0.3 to 12 pixels before a turned camera, awkward ones included.

    Of each ten, one touches a tile border, one lies off the image, and one is behind the near plane
    or the camera. Opacities run from 0.02 to 0.999, some colour channels clamp at zero, and the
    first two share a mean, hence a depth. ``sh`` has 16 coefficients in every degree; flat ones are
    surfels; sample offsets reach half a pixel; ``dialect`` has more fields of ``RasterInputs``.
    """
    generator = torch.Generator().manual_seed(seed)
    view = random_view(generator, width, height)
    pixels, depths = _placements(generator, n, width, height)
    means = unproject(view, pixels, depths)
    if n > 1:
        means = torch.cat([means[:1], means[:1], means[2:]])
    splats = Splats(
        means=means,
        opacities=_uniform(generator, 0.02, 0.999, n),
        scales=_scales(generator, view, depths.abs().clamp(min=0.2)),
        rotations=_rotations(generator, n),
        sh=_sh(generator, n),
        sh_degree=sh_degree,
    )
    if colors:
        splats = replace(splats, sh=None, colors=_uniform(generator, 0.0, 1.2, n, 3), sh_degree=0)
    if cov3d:
        splats = with_cov3d(splats)
    if flat:
        splats = flattened(splats)
    if features:
        splats = replace(splats, features=_uniform(generator, -1.0, 2.0, n, features))
    inputs = RasterInputs(
        view=view,
        splats=splats,
        sample_offsets=_uniform(generator, -0.5, 0.5, height, width, 2) if offsets else None,
        **dialect,
    )
    return cast(inputs, dtype, device)


def flattened(splats: Splats) -> Splats:
    """The same Gaussians as surfels: without their third scale."""
    assert splats.scales is not None
    return replace(splats, scales=splats.scales[:, :2].clone())


def random_thresholds(seed, n, *, dtype=torch.float32, device="cpu"):
    """(N,) thresholds, log-uniform in 0.001 to 0.7; of each eight one neutral, one near 1."""
    generator = torch.Generator().manual_seed(seed)
    tau = _uniform(generator, math.log(1e-3), math.log(0.7), n).exp()
    index = torch.arange(n)
    tau = torch.where(
        index % 8 == 6, torch.sigmoid(torch.tensor(NEUTRAL_LOGIT, dtype=torch.float64)), tau
    )
    return torch.where(index % 8 == 7, 0.98, tau).to(dtype).to(device)


def one_splat(
    pixel: tuple[float, float] = (8.0, 8.0),
    *,
    width: int = 17,
    height: int = 17,
    sigma: tuple[float, float] = (2.0, 2.0),
    angle: float = 0.0,
    depth: float = 2.0,
    opacity: float = 0.8,
    color: tuple[float, float, float] = (0.9, 0.5, 0.1),
    background: tuple[float, float, float] = (0.0, 0.0, 0.0),
    dtype: torch.dtype = torch.float32,
) -> RasterInputs:
    """One flat splat facing an untransformed camera: every pixel can be computed by hand.

    Pixel (0, 0) is the centre of the first one; sigmas are pixels before dilation, the angle is
    from x to the first of them in radians, opacity is before any compensation.
    """
    view = _plain_view(width, height, background)
    at = torch.tensor([pixel], dtype=torch.float64)
    z = torch.tensor([depth], dtype=torch.float64)
    per_pixel = depth / width  # _plain_view: the focal length is the width
    splats = Splats(
        means=unproject(view, at, z),
        opacities=torch.tensor([opacity], dtype=torch.float64),
        scales=torch.tensor(
            [[sigma[0] * per_pixel, sigma[1] * per_pixel, 1e-6]], dtype=torch.float64
        ),
        rotations=torch.tensor(
            [[math.cos(angle / 2), 0.0, 0.0, math.sin(angle / 2)]], dtype=torch.float64
        ),
        colors=torch.tensor([color], dtype=torch.float64),
    )
    return cast(RasterInputs(view=view, splats=splats), dtype)


def stack(opacities, *, dtype=torch.float32, width=17, height=17):
    """Splats behind one another at the image's centre, first in front: for transmittance."""
    layers = [
        one_splat(
            ((width - 1) / 2, (height - 1) / 2),
            width=width,
            height=height,
            depth=2.0 + 0.5 * i,
            opacity=opacity,
            color=(1.0 / (i + 1), 0.5, 0.1 * (i % 10)),
            background=(0.2, 0.3, 0.4),
            dtype=dtype,
        )
        for i, opacity in enumerate(opacities)
    ]
    return replace(layers[0], splats=concatenate([layer.splats for layer in layers]))


def behind_camera(*, dtype: torch.dtype = torch.float32) -> RasterInputs:
    """Three splats that the near plane culls (z = -2, 0.1, exactly 0); nothing is drawn."""
    scene = one_splat(background=(0.1, 0.2, 0.3), dtype=torch.float64)
    means = torch.tensor([[0.0, 0.0, -2.0], [0.0, 0.0, 0.1], [0.1, 0.0, 0.0]], dtype=torch.float64)
    splats = concatenate([scene.splats] * 3)
    return cast(replace(scene, splats=replace(splats, means=means)), dtype)


def empty(width=20, height=18, *, sh_degree=1, dtype=torch.float32):
    """A scene of no Gaussians at all over a coloured background."""
    return random_scene(0, 0, width, height, sh_degree=sh_degree, dtype=dtype)


def leaves(inputs: RasterInputs) -> tuple[RasterInputs, dict[str, Tensor]]:
    """The same inputs made of fresh leaves that require gradients, and those leaves by name.

    Names are the fields of the splats that are present and not whole numbers, "background" and
    "means2d_hook" (zeros).
    """
    splats: dict[str, Any] = {
        name: tensor.detach().clone().requires_grad_()
        for name, tensor in _tensors(inputs.splats).items()
        if tensor.is_floating_point()
    }
    background = inputs.view.background.detach().clone().requires_grad_()
    hook = background.new_zeros(len(inputs.splats), 3).requires_grad_()
    made = replace(
        inputs,
        splats=replace(inputs.splats, **splats),
        view=replace(inputs.view, background=background),
        means2d_hook=hook,
    )
    return made, {**splats, "background": background, "means2d_hook": hook}


def cast(inputs, dtype, device="cpu"):
    """The same inputs in another dtype, on another device."""

    def convert(value: View | Splats | Footprints | RasterInputs) -> dict[str, Any]:
        return {
            name: tensor.to(device, dtype if tensor.is_floating_point() else None).contiguous()
            for name, tensor in _tensors(value).items()
        }

    return replace(
        inputs,
        view=replace(inputs.view, **convert(inputs.view)),
        splats=replace(inputs.splats, **convert(inputs.splats)),
        **convert(inputs),
    )


def concatenate(parts: list[Splats]) -> Splats:
    """All rows of several sets, the first one's first; all must have the same fields."""
    tensors = [_tensors(part) for part in parts]
    return replace(parts[0], **{k: torch.cat([each[k] for each in tensors]) for k in tensors[0]})


def with_cov3d(splats: Splats) -> Splats:
    """The same Gaussians given by 3D covariances instead of scales and rotations."""
    full = covariances(gaussians_of(splats), 1.0)
    i, j = torch.triu_indices(3, 3)
    return replace(splats, scales=None, rotations=None, cov3d=full[:, i, j])


def random_view(generator: torch.Generator, width: int, height: int) -> View:
    """A camera turned and moved at random, focal lengths unequal, background not black; float64."""
    rotation = rotation_matrices(_rotations(generator, 1))[0]
    translation = torch.randn(3, generator=generator, dtype=torch.float64)
    fx, fy = _uniform(generator, 0.8, 1.3, 2).tolist()
    return View.pinhole(
        rotation,
        translation,
        width=width,
        height=height,
        fx=fx * width,
        fy=fy * width,
        background=_uniform(generator, 0.0, 1.0, 3),
    )


def unproject(view: View, pixels: Tensor, depths: Tensor) -> Tensor:
    """(N, 3) world points that land on pixels (N, 2) at depths (N,); inverse of the projection."""
    size = pixels.new_tensor([view.width, view.height])
    tangents = pixels.new_tensor([view.tan_fov_x, view.tan_fov_y])
    ndc = (2 * pixels + 1) / size - 1
    points = torch.cat([ndc * tangents * depths[:, None], depths[:, None]], dim=1)
    rotation, translation = view.viewmatrix[:3, :3], view.viewmatrix[3, :3]
    return (points - translation) @ rotation.T


def _plain_view(width: int, height: int, background: tuple[float, float, float]) -> View:
    """An untransformed camera of focal length width, float64."""
    return View.pinhole(
        torch.eye(3, dtype=torch.float64),
        torch.zeros(3, dtype=torch.float64),
        width=width,
        height=height,
        fx=width,
        fy=width,
        background=torch.tensor(background, dtype=torch.float64),
    )


def _placements(generator: torch.Generator, n: int, width: int, height: int) -> tuple[Tensor, ...]:
    """Pixels (N, 2) and view depths (N,): most inside, some on tile borders, outside, behind."""
    size = torch.tensor([width, height], dtype=torch.float64)
    pixels = _uniform(generator, -0.05, 1.05, n, 2) * size
    depths = _uniform(generator, 1.0, 8.0, n)
    kind = torch.arange(n) % 10
    border = (pixels / TILE).round() * TILE + _uniform(generator, -0.02, 0.02, n, 2)
    pixels = torch.where((kind == 3)[:, None], border, pixels)
    outside = _uniform(generator, 1.1, 2.0, n, 2) * size
    pixels = torch.where((kind == 5)[:, None], outside, pixels)
    return pixels, torch.where(kind == 8, _uniform(generator, -3.0, 0.19, n), depths)


def _scales(generator: torch.Generator, view: View, depths: Tensor) -> Tensor:
    """(N, 3) standard deviations of 0.3 to 12 pixels, log-uniform per axis, in world units."""
    pixels = _uniform(generator, math.log(0.3), math.log(12.0), len(depths), 3).exp()
    return pixels * (depths * 2 * view.tan_fov_x / view.width)[:, None]


def _sh(generator: torch.Generator, n: int) -> Tensor:
    """(N, 16, 3) coefficients around mid-grey, wide enough that some channels go below zero."""
    sh = torch.randn(n, 16, 3, generator=generator, dtype=torch.float64) * 0.25
    dc = _uniform(generator, -0.15, 1.0, n, 1, 3)
    return torch.cat([(dc - 0.5) / SH_DC, sh[:, 1:]], dim=1)


def _rotations(generator: torch.Generator, n: int) -> Tensor:
    """(N, 4) unit quaternions w, x, y, z."""
    quaternions = torch.randn(n, 4, generator=generator, dtype=torch.float64)
    return torch.nn.functional.normalize(quaternions, dim=-1)


def _uniform(generator: torch.Generator, low: float, high: float, *shape: int) -> Tensor:
    """Uniform float64 numbers in [low, high)."""
    return torch.rand(*shape, generator=generator, dtype=torch.float64) * (high - low) + low


def _tensors(value: View | Splats | Footprints | RasterInputs) -> dict[str, Any]:
    """The dataclass's fields that are tensors, by name."""
    pairs = ((f.name, getattr(value, f.name)) for f in fields(value))
    return {name: tensor for name, tensor in pairs if isinstance(tensor, Tensor)}


def blended(view: View, splats: Splats, values: Tensor) -> Tensor:
    """(1, H, W): a number of each Gaussian (N,) blended as a colour, by the oracle in float64."""

    def double(thing: Any, **changes: Any) -> Any:
        held = {k: t.detach().double() for k, t in vars(thing).items() if torch.is_tensor(t)}
        return replace(thing, **held | changes)

    camera = double(view, background=torch.zeros(3, dtype=torch.float64))
    colors = values.double()[:, None].repeat(1, 3)
    drawn = double(splats, colors=colors, sh=None, features=None)
    return ReferenceEngine().rasterize(RasterInputs(camera, drawn), None).image[:1].float()


def footprints_of(inputs: RasterInputs) -> RasterInputs:
    """The same picture of footprints, projected in torch before any engine sees it.

    Row by row, culled ones without tiles; gradients reach the splats.
    """
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
