"""A model as the viewer reads it: two tables of 32-bit words, one after the other, little-endian.

Geometry, 8 words for each Gaussian: the mean as three float32; opacity and cutoff as 16-bit shares
of 1 and of 2 ln 255; the quaternion w x y z, signed 16 bits each; three scales as 16-bit shares of
the way between the least and the largest logarithm; 16 bits unused. Harmonics, as many words as the
degree needs in fours: half floats, red green blue of one coefficient after the other.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray

from fragprune_plugins.constants import ALPHA_MIN
from fragprune_plugins.files.model import Model

Words = NDArray[np.uint32]

CUTOFF_MAX = -2 * math.log(ALPHA_MIN)
"""The largest cutoff that decides anything: a fragment beyond it is fainter than 1/255."""

_HALF_MAX = 65504.0


def _texels(degree: int) -> int:
    """Texels of four words, eight half floats, that hold the harmonics of a degree."""
    return -(-3 * (degree + 1) ** 2 // 8)


def pack(model: Model) -> tuple[bytes, dict[str, Any]]:
    """A model's tables, and what is needed to read them.

    Cutoffs are within 1e-4 of the model's, opacities within 1e-5, and scales within 0.02 % where
    the largest is e^12 times the least.

    Returns:
        The bytes, and: ``gaussians``, ``degree``, ``truncated`` (has thresholds), ``stop`` (after
        which pixels soon end; None for none), ``rim`` (which is always hard there), ``scales``
        (least and largest logarithm of a scale).
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
    geometry[:, 3] = _pair(_unsigned(drawn.opacities), _unsigned(cutoffs))
    turns = np.round(_array(rotation, "<f8") * 32767).astype("<i2").view("<u2")
    geometry[:, 4] = _pair(turns[:, 0], turns[:, 1])
    geometry[:, 5] = _pair(turns[:, 2], turns[:, 3])
    sizes = _unsigned(share)
    geometry[:, 6] = _pair(sizes[:, 0], sizes[:, 1])
    geometry[:, 7] = sizes[:, 2]

    harmonics = np.zeros((count, _texels(degree) * 8), dtype="<f2")
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


def _pair(low: NDArray[Any], high: NDArray[Any]) -> Words:
    pair: Words = low.astype("<u4") | (high.astype("<u4") << np.uint32(16))
    return pair
