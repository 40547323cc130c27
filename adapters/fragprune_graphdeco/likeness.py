"""Compares two rasterizers by number: outputs, what they are, and their gradients."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, replace
from typing import Any, Final

import torch
from torch import Tensor

from fragprune_plugins.adapting import (
    TRANSMITTANCE_MIN,
    Footprints,
    RasterInputs,
    RasterOutputs,
    Splats,
    View,
    rotations,
)

SHARE: Final = 200
"""One pixel or row of so many may differ: a fragment on a cut falls either way by rounding."""
_OUTPUT: Final = 1e-4
"""Of an output's usual size: sums of a pixel's fragments in float32 differ by 2e-5."""
_GRADIENT: Final = 1e-3
"""Of a row's gradient: float32 sums over all pixels, divided by 1 - alpha >= 0.01."""
OWN: Final = 5
"""How much more a host's own call may differ, and in how many more pixels or rows.

Its Gaussians may be long and thin: the hosts' a c - b b then has few digits, and so the exponent
and the gradients. Ours have all."""


def difference(found: Tensor | None, expected: Tensor | None, slack: int = 1) -> str:
    """How an output differs from another, for people; "" if they agree.

    Both are (C, H, W), (H, W) or one number per Gaussian, and may differ ``slack`` times more than
    by rounding.
    """
    if not isinstance(found, Tensor) or not isinstance(expected, Tensor):
        return "" if found is expected else "only one of the two exists"
    if found.numel() != expected.numel():
        return f"{tuple(found.shape)} numbers instead of {tuple(expected.shape)}"
    right = _channels(expected, expected)
    away = (_channels(found, expected) - right).abs()
    return _told(~(away <= slack * _OUTPUT * _usual(right)).all(0), away, slack)


def gradient_differences(
    found: Mapping[str, Tensor | None],
    expected: Mapping[str, Tensor | None],
    leaves: Mapping[str, Tensor],
    slack: int = 1,
) -> Iterator[str]:
    """Name every tensor whose two gradients differ, and how: a row per Gaussian, None for zero."""
    for name, leaf in leaves.items():
        rows = [
            torch.zeros_like(leaf) if each is None else each
            for each in (found[name], expected[name])
        ]
        theirs, right = (each.float().reshape(len(leaf), -1).T for each in rows)
        away, usual = (theirs - right).abs(), float(_usual(right.abs().amax(0)[None]))
        stretch = expected.get("scales")
        if name == "rotations" and stretch is not None:
            # A ball looks the same from all sides: what is left of its gradient is rounding.
            usual = max(usual, float(_usual((leaves["scales"] * stretch).reshape(1, -1))))
        off = ~(away <= slack * (_GRADIENT * right.abs().amax(0) + _OUTPUT * usual))
        if told := _told(off.any(0), away, slack):
            most = slack * len(leaf) // SHARE
            columns = [str(k) for k, each in enumerate(off) if each.sum() > most]
            where = f", column {', '.join(columns)}" if name == "means2D" else ""
            what = "is zero" if not theirs.any() else f"differs: {told}"
            yield f"the gradient of {name}{where} {what}"


def _channels(tensor: Tensor, like: Tensor) -> Tensor:
    """(C, numbers) in double precision, C that of the like of it."""
    return tensor.detach().double().reshape(like.shape[0] if like.ndim > 2 else 1, -1)


def _usual(channels: Tensor) -> Tensor:
    """(C, 1) mean size of each channel's numbers that are not 0."""
    size = channels.detach().abs().nan_to_num(posinf=0)
    return size.sum(1, keepdim=True) / (size > 0).sum(1, keepdim=True).clamp(min=1)


def _told(off: Tensor, away: Tensor, slack: int) -> str:
    """How many of (numbers,) bool are off, and by how much; "" for no more than may be."""
    wrong, total = int(off.sum()), off.numel()
    if wrong <= 1 + slack * total // SHARE:
        return ""
    return f"{wrong} of {total} are off, by up to {float(away.max()):.2g}"


# ---- what an output is -------------------------------------------------------------------------


@dataclass(frozen=True)
class Seen:
    """What our engine draws for a host's call."""

    drawn: RasterOutputs  # its outputs for ``widened`` inputs
    inputs: RasterInputs  # as the dialect made them
    draw: Callable[[RasterInputs], RasterOutputs]  # without thresholds for rows behind these

    @property
    def splats(self) -> Splats | None:
        """The Gaussians, if they are ellipsoids in the world."""
        splats = self.inputs.splats
        return splats if isinstance(splats, Splats) and not splats.flat else None


def _depths(splats: Splats, view: View) -> Tensor:
    """(N, 1) z of the means in view space; no product of matrices, which may be one of TF32."""
    z = splats.means * view.viewmatrix[:3, 2]
    return z.sum(1, keepdim=True) + view.viewmatrix[3, 2]


def _depth(seen: Seen) -> Tensor | None:
    return None if seen.drawn.features is None else seen.drawn.features[-1:]


def _over_alpha(seen: Seen) -> Tensor | None:
    depth, alpha = _depth(seen), seen.drawn.alpha
    return None if depth is None else torch.where(alpha > 0, depth / alpha.clamp(min=1e-12), 0.0)


def _heaviest_depth(seen: Seen) -> Tensor | None:
    """z of the Gaussian of largest weight; 0 where nothing is drawn."""
    rows, splats = seen.drawn.winners, seen.splats
    if rows is None or splats is None:
        return None
    depths = _depths(splats, seen.inputs.view)[rows.clamp(min=0).long(), 0]
    return torch.where(rows >= 0, depths, 0.0)[None]


def _median_depth(seen: Seen) -> Tensor | None:
    """z of the fragment behind which less than half of the light is left; 0 where more is.

    It is what a pixel that stops behind that fragment adds to one that stops before it. The hosts'
    own rule stops there, if two veils in front leave as little light as that.
    """
    splats, view = seen.splats, seen.inputs.view
    if splats is None or splats.scales is None:
        return None
    depths = _depths(splats, view)
    plain = replace(splats, features=torch.cat([torch.ones_like(depths), depths], 1))
    near, opaque = (1 + 1e-5) * max(seen.inputs.near, 1e-3), 1 - (2 * TRANSMITTANCE_MIN) ** 0.5
    to_world, like = torch.linalg.inv(view.viewmatrix.double().cpu()), splats.means
    veil = {
        "means": (near * to_world[2] + to_world[3])[None, :3],
        "scales": like.new_full((1, 3), 2e5 * near * max(view.tan_fov_x, view.tan_fov_y)),
        "rotations": like.new_tensor([[1.0, 0.0, 0.0, 0.0]]),
        "opacities": like.new_tensor([opaque]),
    }
    own = {name: each for name, each in vars(plain).items() if isinstance(each, Tensor)}
    rows = {name: veil.get(name, torch.zeros_like(each[:1])).to(each) for name, each in own.items()}
    veiled: Any = {name: torch.cat([each, rows[name], rows[name]]) for name, each in own.items()}
    inputs = replace(seen.inputs, splats=plain, means2d_hook=None, stop=0.5)
    behind = seen.draw(inputs).features
    before = seen.draw(replace(inputs, splats=replace(plain, **veiled), stop=None)).features
    if behind is None or before is None:
        return None
    weight, depth = behind - before / (1 - float(veil["opacities"])) ** 2
    return torch.where(behind[0] > 0.5, depth / weight.clamp(min=1e-3), 0.0)[None]


def _normals(seen: Seen, *signs: int) -> Tensor | None:
    """(3, H, W) sum of alpha T n, n being the shortest axis, turned towards the camera.

    With signs of the axes of view space in it, else in the world.
    """
    splats, view = seen.splats, seen.inputs.view
    if splats is None or splats.scales is None or splats.rotations is None:
        return None
    axes = rotations(torch.nn.functional.normalize(splats.rotations, dim=1)).mT
    normals = axes[torch.arange(len(axes), device=axes.device), splats.scales.argmin(1)]
    away = (normals * (splats.means - view.campos)).sum(1, keepdim=True) > 0
    normals = torch.where(away, -normals, normals)
    if signs:
        turned = (normals[:, :, None] * view.viewmatrix[:3, :3]).sum(1)  # as _depths
        normals = turned * normals.new_tensor(signs)
    return seen.draw(replace(seen.inputs, splats=replace(splats, features=normals))).features


MEANINGS: Final[Mapping[str, Callable[[Seen], Tensor | None]]] = {
    "the picture": lambda seen: seen.drawn.image,
    "alpha": lambda seen: seen.drawn.alpha,
    "transmittance": lambda seen: 1 - seen.drawn.alpha,
    "depth": _depth,
    "depth over alpha": _over_alpha,
    "inverse depth": lambda seen: seen.drawn.invdepth,
    "median depth": _median_depth,
    "depth of the largest weight": _heaviest_depth,
    "normals": _normals,
    "normals in view space": lambda seen: _normals(seen, 1, 1, 1),
    "normals in view space, y up": lambda seen: _normals(seen, 1, -1, -1),
    "radii": lambda seen: seen.drawn.radii,
    "on screen": lambda seen: seen.drawn.radii > 0,
    "fragments": lambda seen: seen.drawn.fragments,
    "fragments of each Gaussian": lambda seen: seen.drawn.fragments_per_gaussian,
    "weight of each Gaussian": lambda seen: seen.drawn.weights_per_gaussian,
    "pixels won by each Gaussian": lambda seen: seen.drawn.wins_per_gaussian,
}
"""What a rasterizer may give back, made from what our engine draws.

Depth is the sum of alpha T z, and inverse depth that of alpha T / z, both without background."""


def widened(inputs: RasterInputs) -> RasterInputs:
    """Inputs whose outputs have all meanings: every plane and score, z as the last feature.

    Surfels have no features, and so no depth of this kind.
    """
    splats, view = inputs.splats, inputs.view
    if isinstance(splats, Splats) and splats.flat:
        return replace(inputs, counts=True, scores=True)
    depths = splats.depths[:, None] if isinstance(splats, Footprints) else _depths(splats, view)
    features = depths if splats.features is None else torch.cat([splats.features, depths], 1)
    return replace(
        inputs,
        splats=replace(splats, features=features),
        planes=("invdepth", "alpha"),
        counts=True,
        scores=True,
    )


def narrowed(drawn: RasterOutputs) -> RasterOutputs:
    """The outputs without the feature that ``widened`` added."""
    own = drawn.features[:-1] if drawn.features is not None else None
    return replace(drawn, features=own if own is not None and len(own) else None)


def meaning(output: Tensor | None, seen: Seen) -> str:
    """The one meaning that an output agrees with; "" for none, for several and for a constant."""
    if not isinstance(output, Tensor) or output.numel() == 0 or output.amin() == output.amax():
        return ""
    fits = [name for name, of in MEANINGS.items() if not difference(output, of(seen))]
    return fits[0] if len(fits) == 1 else ""


# ---- a scene that shows every rule -------------------------------------------------------------


def chart(arguments: Mapping[str, Tensor], view: View) -> dict[str, Tensor]:
    """Arguments of the same names for Gaussians that show every rule of a rasterizer in a picture.

    They are as small as the low-pass filter and as wide as the picture; faint and opaque; near the
    near plane, behind it, and beyond the picture's edge; some of their colours are negative. They
    leave a part of the picture empty. Other arguments keep the host's own rows.
    """
    random, like = torch.Generator().manual_seed(7), arguments["means3D"]
    count = max(160, view.width * view.height // 48)

    def uniform(low: float, high: float, *shape: int) -> Tensor:
        return torch.rand(count, *shape, generator=random) * (high - low) + low

    def normal(*shape: int) -> Tensor:
        return torch.randn(count, *shape, generator=random)

    number = torch.arange(count)
    wide, beyond, kind = number < 40, (number >= 40) & (number < 44), number % 16
    depths, opacities = uniform(1.5, 6.0), uniform(0.02, 0.6)
    depths = depths.where(kind != 0, uniform(0.1, 0.3)).where(kind != 1, uniform(-2.0, -1.0))
    depths = depths.where(~wide, uniform(7.0, 9.0)).where(~beyond, 3.0 + 0.1 * (number - 40))
    opacities = opacities.where(~wide & (kind != 2), 0.9995)
    pixels = torch.exp(uniform(math.log(0.3), math.log(6.0)))  # standard deviations
    pixels = pixels.where(~wide, view.width / 12).where(~beyond, view.width / 8)
    tangents = uniform(-1.2, 0.6, 2)
    tangents[beyond, 0] = 1.5  # so far out, the projection is another one
    fov = torch.tensor([view.tan_fov_x, view.tan_fov_y])
    means = torch.cat([tangents * fov * depths[:, None], depths[:, None]], 1)
    world = view.viewmatrix.detach().double().cpu()
    means = ((means.double() - world[3, :3]) @ torch.linalg.inv(world[:3, :3])).float()
    sizes = (pixels * depths.abs() * 2 * view.tan_fov_x / view.width)[:, None]
    axes = sizes[:, None] * (torch.eye(3) + 0.4 * normal(3, 3))
    spread = axes @ axes.mT
    made = {
        "means3D": means,
        "opacities": opacities[:, None],
        "scales": sizes * torch.exp(0.5 * normal(3)),
        "rotations": torch.nn.functional.normalize(normal(4), dim=1),
        "cov3D_precomp": spread.flatten(1)[:, [0, 1, 2, 4, 5, 8]],
        "colors_precomp": uniform(0.0, 1.0, 3),
        "dc": 1.5 * normal(1, 3),
        "shs": 0.3 * normal(16, 3),
    }
    if "dc" not in arguments:
        made["shs"][:, :1] *= 5
    rows = torch.arange(count, device=like.device)
    filled = {}
    for name, own in arguments.items():
        new = made.get(name)
        if new is None and own.is_floating_point() and own[0].numel() > 2 and own.any():
            new = uniform(0.5, 1.5, *own.shape[1:])  # channels, of which a host may make ratios,
            new.reshape(count, -1)[:, 2] *= 4  # as of a normal that faces the camera
        if new is None or any(a < b for a, b in zip(new.shape[1:], own.shape[1:], strict=False)):
            filled[name] = own.detach()[rows % len(own)]
        else:
            cut = new[:, : own.shape[1]] if own.ndim > 1 else new
            filled[name] = cut.reshape(count, *own.shape[1:]).to(own)
    return filled
