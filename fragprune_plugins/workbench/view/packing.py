"""A model as the viewer reads it: two tables of 32-bit words, one after the other, little-endian.

Geometry, 8 words for each Gaussian: the mean as three float32; opacity and cutoff as 16-bit shares
of 1 and of 2 ln 255; the quaternion w x y z, signed 16 bits each; three scales as 16-bit shares of
the way between the least and the largest logarithm; 16 bits unused. Harmonics, as many words as the
degree needs in fours: half floats, red green blue of one coefficient after the other.

A page that is written has them in few bytes (``compact``). Gaussians are sorted along a Z-order
curve, their numbers become codes, and bytes of equal meaning lie one after the other, deflated.
Numbers are rounded as in a .spz file where there are more than 256 different ones: a model of such
a file stays what it is. ``static/compact.js`` makes tables of the bytes. These are, of N Gaussians
and before they are deflated:

* Means: of x, y and z, 4 planes of N bytes each, the lowest first. They hold the difference to the
  Gaussian before in units of ``2**-bits``, doubled, and inverted where it is negative.
* Rotations: 4 planes. The first three hold the lower 8 of 9 bits of the three smaller components,
  as shares of the square root of 1/2; the last their ninth bits, their signs, and in its two
  highest bits which component is the largest, which is positive.
* Opacities, cutoffs, scales, colours: a book of 256 words as the tables have them, then a plane of
  codes for each column.
* Other harmonics: a book, and planes of the ``rows`` different rows; if these are fewer than N,
  4 more planes say which of them a Gaussian has.
"""

from __future__ import annotations

import math
import zlib
from collections.abc import Callable
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray

from fragprune_plugins.constants import ALPHA_MIN
from fragprune_plugins.files.model import Model
from fragprune_plugins.workbench.models.formats.arrays import Bytes, z_order
from fragprune_plugins.workbench.models.formats.palette import codebook, nearest

CUTOFF_MAX = -2 * math.log(ALPHA_MIN)  # a fragment beyond it is fainter than 1/255
_HALF_MAX = 65504.0


def pack(model: Model) -> tuple[bytes, dict[str, Any]]:
    """A model's tables, and what is needed to read them.

    Cutoffs are within 1e-4 of the model's, opacities within 1e-5, and scales within 0.02 % where
    the largest is e^12 times the least. Of the facts, ``scales`` are the least and the largest
    logarithm of a scale.
    """
    drawn, falloff = model.splats(), model.falloff
    count, degree = len(model), model.sh_degree
    assert drawn.scales is not None
    scales = drawn.scales.log()
    low, high = float(scales.min()), float(scales.max())
    share = (scales - low) / max(high - low, 1e-6)
    cutoffs = torch.ones(count) if falloff is None else -2 * falloff.double().log() / CUTOFF_MAX
    rotation = torch.nn.functional.normalize(model.rotation)

    geometry = np.empty((count, 8), dtype="<u4")
    geometry[:, :3] = _array(model.xyz, "<f4").view("<u4")
    halves = geometry.view("<u2")  # of a word, the lower first
    halves[:, 6], halves[:, 7] = _unsigned(drawn.opacities), _unsigned(cutoffs)
    halves[:, 8:12] = np.round(_array(rotation, "<f8") * 32767).astype("<i2").view("<u2")
    halves[:, 12:15], halves[:, 15] = _unsigned(share), 0

    texels = -(-3 * (degree + 1) ** 2 // 8)  # of four words, eight half floats
    harmonics = np.zeros((count, texels * 8), dtype="<f2")
    values = _array(torch.cat([model.f_dc, model.f_rest], dim=1).flatten(1), "<f4")
    harmonics[:, : values.shape[1]] = values.clip(-_HALF_MAX, _HALF_MAX)
    facts = {
        "gaussians": count,
        "degree": degree,
        "truncated": falloff is not None,
        **model.rules,
        "scales": [low, max(high, low + 1e-6)],
    }
    return geometry.tobytes() + harmonics.tobytes(), facts


def _array(tensor: torch.Tensor, kind: str) -> NDArray[Any]:
    return np.ascontiguousarray(tensor.detach().cpu().numpy(), dtype=kind)


def _unsigned(shares: torch.Tensor) -> NDArray[np.uint16]:
    """Numbers as 16-bit shares of 1; those outside of [0, 1] as its ends."""
    return np.round(_array(shares, "<f8").clip(0, 1) * 65535).astype("<u2")


Words = NDArray[np.uint16]
_BOOK, _BITS = 256, 12
_STEPS = 2048  # least number of steps of a mean from the middle of a scene to its edge
_FARTHEST = 1 << 29  # steps of a mean whose differences surely fit into 32 bits
_LEVEL = 7  # of zlib: 9 takes up to seven times as long for 1.6 % fewer bytes


def compact(tables: bytes, facts: dict[str, Any]) -> tuple[bytes, dict[str, int], list[str]]:
    """What ``pack`` gave, in few bytes; OverflowError if a mean is too far from all others.

    Returns the bytes; ``bits`` and ``rows`` for the facts; what was rounded, as words for the user.
    """
    count, coefficients = facts["gaussians"], 3 * (facts["degree"] + 1) ** 2
    geometry = np.frombuffer(tables, "<u4", count * 8).reshape(count, 8)
    harmonics = np.frombuffer(tables, "<u2", offset=geometry.nbytes).reshape(count, -1)
    order = z_order(geometry[:, :3].view("<f4"))
    words, harmonics = geometry[order].view("<u2"), harmonics[order, :coefficients]

    means = geometry[order, :3].view("<f4").astype(np.float64)
    bits = _bits(means)
    fixed = np.rint(means * 2.0**bits)
    rotations, turned = _rotations(words[:, 8:12].view("<i2"))
    steps: Any = np.diff(fixed.astype(np.int32), axis=0, prepend=np.int32(0))
    parts = [_planes(((steps << 1) ^ (steps >> 31)).T), rotations.T]
    changed = {"positions": bool((fixed != means * 2.0**bits).any()), "rotations": turned}

    low, high = facts["scales"]
    rounding: dict[str, tuple[Words, Callable[[Words], Any]]] = {
        "opacities": (words[:, 6:7], lambda shares: np.rint(shares / 257) * 257),  # to 8 bits
        "cutoffs": (words[:, 7:8], _cutoffs),
        "scales": (words[:, 12:15], lambda scales: _scales(scales, high - low)),
        "colours": (harmonics[:, :3], _colours),
        "harmonics": (harmonics[:, 3:], _harmonics),
    }
    rows = count
    for name, (columns, rounded) in rounding.items():
        values = rounded(columns).astype(np.uint16)
        changed[name] = bool((np.abs(values.astype(np.int32) - columns) > 1).any())
        seen = np.bincount(values.reshape(-1)) > 0
        book, codes = np.flatnonzero(seen), (np.cumsum(seen) - 1).astype(np.uint8)[values]
        parts.append(np.pad(book.astype("<u2"), (0, _BOOK - len(book))))
        if name == "harmonics" and codes.size:
            different, index = np.unique(codes, axis=0, return_inverse=True)
            if len(different) <= 0.75 * count:  # else all rows stay, as they are
                codes, rows = different, len(different)
                parts.append(_planes(index.ravel()))
        parts.append(codes.T)
    data = zlib.compress(b"".join(np.ascontiguousarray(each).tobytes() for each in parts), _LEVEL)
    return data, {"bits": bits, "rows": rows}, [name for name in changed if changed[name]]


def _bits(means: NDArray[np.float64]) -> int:
    """Bits of the fraction of means."""
    bits = _BITS
    away = np.abs(means - np.median(means, axis=0)).max(axis=1)
    most, radius = float(np.abs(means).max()), max(float(np.quantile(away, 0.9)), 1e-3)
    while radius * 2.0**bits < _STEPS:
        bits += 1
    while bits > _BITS and most * 2.0**bits >= _FARTHEST:
        bits -= 1
    if most * 2.0**bits >= _FARTHEST:
        raise OverflowError(f"a mean at {most:.6g}")
    return bits


def _planes(numbers: NDArray[Any]) -> Bytes:
    """(..., N) numbers as (..., 4, N) bytes, the lowest first."""
    held = np.ascontiguousarray(numbers.astype("<u4")).view(np.uint8)
    planes: Bytes = np.moveaxis(held.reshape(*numbers.shape, 4), -1, -2)
    return planes


def _rotations(turns: NDArray[np.int16]) -> tuple[Bytes, bool]:
    """(N, 4) bytes of quaternions, and whether they are farther off than by a unit."""
    rows, sizes = np.arange(len(turns)), np.abs(turns.astype(np.int32))
    unit = 32767 * 0.5**0.5 / 511
    codes = np.rint(sizes / unit).astype(np.int32)
    off = np.abs(np.rint(codes * unit) - sizes)
    # Of components that are nearly as large the one that fits least: a .spz file has left it out.
    largest = np.where(sizes > sizes.max(axis=1, keepdims=True) - 2 * unit, off, -1).argmax(axis=1)
    others = np.arange(4) != largest[:, None]
    three = codes[others].reshape(-1, 3).clip(max=511)
    negative = ((turns < 0) ^ (turns[rows, largest] < 0)[:, None])[others].reshape(-1, 3)
    upper = largest << 6
    for k in range(3):
        upper |= (three[:, k] >> 8) << (2 * k + 1) | negative[:, k].astype(np.int64) << (2 * k)
    return np.column_stack([three & 255, upper]).astype(np.uint8), bool((off[others] > 1).any())


def _cutoffs(shares: Words) -> Any:
    """To the codes of docs/reference/cutoff.md."""
    return np.rint(np.rint(shares * (256 / 65535)).clip(1, 256) * (65535 / 256))


def _scales(shares: Words, extent: float) -> Any:
    """To steps of 1/16 of a logarithm, or to 256 values if that is more."""
    step = 65535 / 16 / extent
    rounded = np.rint(np.rint(shares / step) * step).clip(0, 65535).astype(np.uint16)
    if len(np.unique(rounded)) <= _BOOK:
        return rounded
    book = codebook(shares)
    return np.rint(book)[nearest(book, shares)]


def _singles(halves: Words) -> NDArray[np.float32]:
    """In float32, to which only NumPy 2 brings half floats by itself."""
    return halves.view(np.float16).astype(np.float32)


def _colours(halves: Words) -> Any:
    """To 8 bits."""
    levels = np.floor(_singles(halves) * np.float32(0.15 * 255) + 128).clip(0, 255)
    return ((levels / 255 - 0.5) / 0.15).astype(np.float16).view(np.uint16)


def _harmonics(halves: Words) -> Any:
    """To 5 bits of degree 1, and to 4 bits."""
    step = np.where(np.arange(halves.shape[1]) < 9, 8, 16)
    levels = np.floor(np.rint(_singles(halves) * np.float32(128)) / step + 0.5) * step
    return (levels.clip(-128, 127) / 128 + 0).astype(np.float16).view(np.uint16)
