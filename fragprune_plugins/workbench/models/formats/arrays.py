"""What formats share: arrays to and from a ``Model``, activations, order, bounded streams."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import numpy.typing as npt
import torch
from torch import Tensor

from fragprune_plugins.constants import NEUTRAL_LOGIT
from fragprune_plugins.files.model import Model
from fragprune_plugins.files.reading import MEBIBYTE
from fragprune_plugins.learning.thresholds import ThresholdStore
from fragprune_plugins.types import Rim
from fragprune_plugins.workbench.models import cutoffs

Floats = npt.NDArray[np.float32]
Bytes = npt.NDArray[np.uint8]
SH_C0 = 0.28209479177387814  # the SH basis function of degree 0: a colour is 0.5 + SH_C0 f_dc
SH_RESTS = (0, 3, 8, 15)  # how many coefficients of degree 1 and more a degree has
_SCALE_MIN = 1e-30  # some writers leave 0, which has no logarithm
_ALPHA_EDGE = 1e-6  # an 8-bit opacity of 0 or 255 has no finite logit


def splat_of(
    *,
    xyz: npt.NDArray[Any],
    colours: npt.NDArray[Any],
    rest: npt.NDArray[Any],
    opacities: npt.NDArray[Any],
    log_scales: npt.NDArray[Any],
    rotations: npt.NDArray[Any],
    thresholds: Tensor | None = None,
    stop: float | None = None,
    rim: Rim = "hard",
) -> Model:
    """A splat of arrays; ValueError without Gaussians, or for thresholds out of range.

    Args:
        xyz: (N, 3) means.
        colours: (N, 3) first SH coefficients; ``rest`` (N, K - 1, 3) are the others.
        opacities: (N,) in [0, 1], activated.
        log_scales: (N, 3) logarithms of standard deviations.
        rotations: (N, 4) quaternions w, x, y, z; one of length 0 becomes no rotation.
        thresholds: (N,) in (0, 1), or None; ``stop`` and ``rim`` are those of ``RasterInputs``.
    """
    if not len(xyz):
        raise ValueError("0 Gaussians")
    if thresholds is not None and not ((thresholds > 0) & (thresholds < 1)).all():
        raise ValueError("thresholds outside (0, 1)")
    inside = np.clip(np.asarray(opacities, np.float64), _ALPHA_EDGE, 1 - _ALPHA_EDGE)
    rotations = np.array(rotations, np.float32, order="C")  # else each frame copies them
    rotations[(rotations == 0).all(axis=1), 0] = 1

    def tensor(values: npt.NDArray[Any]) -> Tensor:
        with np.errstate(over="ignore"):
            return torch.from_numpy(np.array(values, np.float32))

    model = Model(
        xyz=tensor(xyz),
        f_dc=tensor(colours)[:, None],
        f_rest=tensor(rest),
        opacity=tensor(np.log(inside / (1 - inside)))[:, None],
        scaling=tensor(log_scales),
        rotation=torch.from_numpy(rotations),
        thresholds=None if thresholds is None else ThresholdStore.from_falloff(thresholds),
    )
    return model if stop is None and rim == "hard" else model.with_rules(stop=stop, rim=rim)


def logs_of(scales: npt.NDArray[Any]) -> npt.NDArray[Any]:
    """Logarithms of standard deviations; ValueError if one is negative."""
    if (scales < 0).any():
        raise ValueError("negative scales")
    logs: npt.NDArray[Any] = np.log(np.maximum(scales, _SCALE_MIN))
    return logs


def rules_of(splat: Model) -> dict[str, Any]:
    """A model's stop and rim by name, those of them that differ from the hosts' rules."""
    hosts = {"stop": None, "rim": "hard"}
    return {name: rule for name, rule in splat.rules.items() if rule != hosts[name]}


def of_codes(codes: Bytes) -> Tensor | None:
    """The thresholds of codes; those that cut nothing are neutral, and None if all are."""
    if not codes.any():
        return None
    thresholds = torch.from_numpy(cutoffs.decode(codes))
    thresholds[torch.from_numpy(codes == cutoffs.NEUTRAL)] = torch.tensor(NEUTRAL_LOGIT).sigmoid()
    return thresholds


def codes_of(splat: Model) -> Bytes | None:
    """The codes of its thresholds; None where nothing is cut, so that nothing need be written."""
    if (falloff := splat.falloff) is None:
        return None
    codes = cutoffs.encode(falloff.numpy())
    return codes if codes.any() else None


def array(values: Tensor) -> Floats:
    """A tensor's values, float32."""
    return values.detach().float().numpy()


def opacities_of(splat: Model) -> Floats:
    """(N,) activated opacities."""
    return array(torch.sigmoid(splat.opacity[:, 0]))


def quaternions_of(splat: Model) -> Floats:
    """(N, 4) unit quaternions w, x, y, z."""
    return array(torch.nn.functional.normalize(splat.rotation))


def without_largest(quaternions: Floats) -> tuple[npt.NDArray[np.int64], Floats]:
    """(N,) which component of (N, 4) is the largest, and (N, 3) the others where it is positive."""
    largest = np.abs(quaternions).argmax(axis=1)
    sign = np.where(quaternions[np.arange(len(quaternions)), largest] < 0, -1, 1)
    others = np.arange(4)[None] != largest[:, None]
    three: Floats = (quaternions * sign[:, None])[others].reshape(-1, 3)
    return largest, three


def with_largest(largest: npt.NDArray[Any], three: npt.NDArray[Any]) -> npt.NDArray[np.float64]:
    """(N, 4) unit quaternions, from what ``without_largest`` gives."""
    full = np.zeros((len(three), 4))
    others = np.arange(4)[None] != largest[:, None]
    full[others] = three.ravel()
    full[~others] = np.sqrt(np.maximum(0, 1 - (three**2).sum(axis=1)))
    return full


def byte(values: npt.NDArray[Any]) -> Bytes:
    """Values rounded to 0..255; halves go up."""
    return np.clip(np.floor(values + 0.5), 0, 255).astype(np.uint8)


def ordered(splat: Model, rows: Tensor) -> Model:
    """The Gaussians of these rows, in this order, of a model without thresholds."""
    taken: dict[str, Any] = {name: each[rows] for name, each in splat.tensors.items()}
    return replace(splat, **taken)


def morton_order(splat: Model) -> Tensor:
    """(N,) rows along a Z-order curve: near ones in space are near in the file."""
    return torch.from_numpy(z_order(array(splat.xyz)))


def z_order(xyz: Floats) -> npt.NDArray[np.int64]:
    """(N,) rows of (N, 3) points along a Z-order curve."""
    points = xyz.astype(np.float64)
    low, high = points.min(axis=0), points.max(axis=0)
    cells = (1023 * (points - low) / np.maximum(high - low, 1e-30)).astype(np.uint32)
    for shift, mask in ((16, 0x030000FF), (8, 0x0300F00F), (4, 0x030C30C3), (2, 0x09249249)):
        cells = (cells | (cells << shift)) & mask
    order: npt.NDArray[np.int64] = np.argsort(cells @ np.array([1, 2, 4], np.uint32), kind="stable")
    return order


def turned(splat: Model, signs: tuple[int, int, int]) -> Model:
    """The same scene with axes negated by signs 1 or -1: means, rotations, SH of degrees 1 to 3."""
    x, y, z = signs
    per_axis = torch.tensor(signs, dtype=torch.float32)
    turn = torch.tensor([1, y * z, x * z, x * y], dtype=torch.float32)
    sh = [y, z, x, x * y, y * z, 1, x * z, 1, y, x * y * z, y, z, x, z, x]
    rest = splat.f_rest * torch.tensor(sh[: splat.f_rest.shape[1]]).float()[None, :, None]
    return replace(splat, xyz=splat.xyz * per_axis, f_rest=rest, rotation=splat.rotation * turn)


def take(stream: Any, count: int) -> bytes:
    """Exactly so many bytes of a stream that decompresses; allocates no more than it gives."""
    data = bytearray()
    while missing := count - len(data):
        piece = stream.read(min(missing, MEBIBYTE))
        if not piece:
            raise EOFError(f"{count} bytes announced, {len(data)} there")
        data += piece
    return bytes(data)


def expect_plausible(count: int, size: int) -> None:
    """Raise ValueError if so many bytes cannot hold the positions of so many Gaussians.

    A byte of a compressed file stands for one at most; of scenes, for a tenth of one.
    """
    if not 0 < count <= size:
        raise ValueError(f"{count} Gaussians in {size} bytes")
