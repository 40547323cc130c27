"""Compares two rasterizers by number: outputs, what they are, and their gradients."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Mapping
from dataclasses import replace
from typing import Final

import torch
from torch import Tensor

from fragprune_plugins.types import Footprints, RasterInputs, RasterOutputs, Splats, View

SHARE: Final = 200
"""One pixel or row of so many may differ: a fragment on a cut falls either way by rounding."""
_OUTPUT: Final = 1e-4
"""Of an output's usual size: sums of a pixel's fragments in float32 differ by 2e-5."""
_GRADIENT: Final = 1e-3
"""Of a row's gradient: float32 sums over all pixels, divided by 1 - alpha >= 0.01."""


def difference(found: Tensor | None, expected: Tensor | None) -> str:
    """How an output differs from another, for people; "" if they agree.

    Args:
        found: (C, H, W), (H, W) or one number per Gaussian.
        expected: as many numbers.
    """
    if not isinstance(found, Tensor) or not isinstance(expected, Tensor):
        return "" if found is expected else "only one of the two exists"
    if found.numel() != expected.numel():
        return f"{tuple(found.shape)} numbers instead of {tuple(expected.shape)}"
    right = _channels(expected, expected)
    away = (_channels(found, expected) - right).abs()
    return _told(~(away <= _OUTPUT * _usual(right)).all(0), away)


def gradient_differences(
    found: Mapping[str, Tensor | None],
    expected: Mapping[str, Tensor | None],
    leaves: Mapping[str, Tensor],
) -> Iterator[str]:
    """Name every tensor whose two gradients differ, and how.

    Args:
        found: gradients by name, one row per Gaussian; None for zero.
        expected: the right ones.
        leaves: the tensors themselves.
    """
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
        off = ~(away <= _GRADIENT * right.abs().amax(0) + _OUTPUT * usual)
        if told := _told(off.any(0), away):
            columns = [str(k) for k, each in enumerate(off) if each.sum() > len(leaf) // SHARE]
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


def _told(off: Tensor, away: Tensor) -> str:
    """How many of (numbers,) bool are off, and by how much; "" for no more than may be."""
    wrong, total = int(off.sum()), off.numel()
    if wrong <= 1 + total // SHARE:
        return ""
    return f"{wrong} of {total} are off, by up to {float(away.max()):.2g}"


# ---- what an output is -------------------------------------------------------------------------


def _depth(drawn: RasterOutputs) -> Tensor | None:
    return None if drawn.features is None else drawn.features[-1:]


def _over_alpha(drawn: RasterOutputs) -> Tensor | None:
    depth = _depth(drawn)
    if depth is None:
        return None
    return torch.where(drawn.alpha > 0, depth / drawn.alpha.clamp(min=1e-12), 0.0)


MEANINGS: Final[Mapping[str, Callable[[RasterOutputs], Tensor | None]]] = {
    "the picture": lambda drawn: drawn.image,
    "alpha": lambda drawn: drawn.alpha,
    "transmittance": lambda drawn: 1 - drawn.alpha,
    "depth": _depth,
    "depth over alpha": _over_alpha,
    "inverse depth": lambda drawn: drawn.invdepth,
    "radii": lambda drawn: drawn.radii,
    "on screen": lambda drawn: drawn.radii > 0,
    "fragments": lambda drawn: drawn.fragments,
    "fragments of each Gaussian": lambda drawn: drawn.fragments_per_gaussian,
    "weight of each Gaussian": lambda drawn: drawn.weights_per_gaussian,
    "pixels won by each Gaussian": lambda drawn: drawn.wins_per_gaussian,
}
"""What a rasterizer may give back, made from an engine's outputs for ``widened`` inputs.

Depth is the sum of alpha T z, and inverse depth that of alpha T / z, both without background."""


def widened(inputs: RasterInputs) -> RasterInputs:
    """Inputs whose outputs have all meanings: every plane and score, z as the last feature.

    Surfels have no features, and so no depth of this kind.
    """
    splats, view = inputs.splats, inputs.view
    if isinstance(splats, Splats) and splats.flat:
        return replace(inputs, counts=True, scores=True)
    if isinstance(splats, Footprints):
        depths = splats.depths[:, None]
    else:
        depths = splats.means @ view.viewmatrix[:3, 2:3] + view.viewmatrix[3, 2]
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


def meaning(output: Tensor | None, drawn: RasterOutputs) -> str:
    """The one meaning that an output agrees with; "" for none, for several and for a constant."""
    if not isinstance(output, Tensor) or output.numel() == 0 or output.amin() == output.amax():
        return ""
    fits = [name for name, of in MEANINGS.items() if not difference(output, of(drawn))]
    return fits[0] if len(fits) == 1 else ""


# ---- a scene that shows every rule -------------------------------------------------------------


def chart(arguments: Mapping[str, Tensor], view: View) -> dict[str, Tensor]:
    """Arguments of the same names for Gaussians that show every rule of a rasterizer in a picture.

    They are as small as the low-pass filter and as wide as the picture; faint and opaque; near the
    near plane, behind it, and beyond the picture's edge; some of their colours are negative. They
    leave a part of the picture empty. Other arguments keep the host's own rows.

    Args:
        arguments: the host's, one row per Gaussian.
        view: the camera.
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
    depths = depths.where(~wide, uniform(7.0, 9.0)).where(~beyond, 3.0)
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
        if new is None or any(a < b for a, b in zip(new.shape[1:], own.shape[1:], strict=False)):
            filled[name] = own.detach()[rows % len(own)]
        else:
            cut = new[:, : own.shape[1]] if own.ndim > 1 else new
            filled[name] = cut.reshape(count, *own.shape[1:]).to(own)
    return filled
