"""The compressed PLY of PlayCanvas and SuperSplat: Gaussians in chunks of 256, 16 bytes each.

Element ``chunk`` holds the ranges of positions, log scales and colours; ``vertex`` four packed
uint32; ``sh`` the coefficients of degree 1 and more, uint8 over [-4, 4].
"""

from __future__ import annotations

from pathlib import Path
from typing import Any, BinaryIO

import numpy as np
import numpy.typing as npt

from fragprune_plugins.files.model import Model
from fragprune_plugins.files.ply_table import HEADER_MAX, header_lines, read_elements
from fragprune_plugins.files.reading import Reading
from fragprune_plugins.workbench.models.formats import Format, arrays

_CHUNK = 256
_SCALE_LIMIT = 20.0  # of logarithms, as the format's own writer has it
_HALF_SQRT2 = 0.5 * 2**0.5


def _names(what: str) -> tuple[list[str], list[str]]:
    axes = "rgb" if what == "colour" else "xyz"
    middle = "scale_" if what == "scale" else ""
    low, high = ([f"{end}_{middle}{axis}" for axis in axes] for end in ("min", "max"))
    return low, high


_VERTEX = ["packed_position", "packed_rotation", "packed_scale", "packed_color"]


def lies_at(path: Path) -> bool:
    """Whether a file is a PLY of this kind."""
    try:
        if not path.is_file():
            return False
        with open(path, "rb") as file:
            head = file.read(3)
            head += file.read(HEADER_MAX) if head == b"ply" else b""
        lines = header_lines(head)[0]
    except (OSError, ValueError):  # whoever reads it states what is wrong
        return False
    return any(line.strip().endswith(b" packed_position") for line in lines)


def read(reading: Reading) -> Model:
    """The Gaussians of an open file."""
    elements = read_elements(reading, ("chunk", "vertex", "sh"))
    chunk, vertex = elements["chunk"], elements["vertex"]
    position, rotation, scale, colour = (vertex[name].astype(np.uint32) for name in _VERTEX)
    count = len(position)
    of = np.arange(count) // _CHUNK
    if len(next(iter(chunk.values()))) != -(-count // _CHUNK):
        raise ValueError("another number of chunks than its Gaussians need")

    def ranged(packed: npt.NDArray[Any], what: str) -> Any:
        low, high = (np.stack([chunk[name] for name in names], 1) for names in _names(what))
        return low[of] + (high - low)[of] * packed

    rgba = _unpacked(colour, (8, 8, 8, 8))
    rgb = ranged(rgba[:, :3], "colour") if "min_r" in chunk else rgba[:, :3]
    sh = elements.get("sh", {})
    columns = [sh[f"f_rest_{i}"] for i in range(len(sh))]
    coefficients = np.stack(columns, 1) if columns else np.zeros((count, 0), np.uint8)
    if len(coefficients) != count:
        raise ValueError("another number of rows of sh than of Gaussians")
    fractions = (coefficients + 0.5) / 256
    fractions[coefficients == 0], fractions[coefficients == 255] = 0, 1
    return arrays.splat_of(
        xyz=ranged(_unpacked(position, (11, 10, 11)), "position"),
        colours=(rgb - 0.5) / arrays.SH_C0,
        rest=(8 * (fractions - 0.5)).reshape(count, 3, -1).transpose(0, 2, 1),
        opacities=rgba[:, 3],
        log_scales=ranged(_unpacked(scale, (11, 10, 11)), "scale"),
        rotations=_rotations(rotation),
    )


def write(file: BinaryIO, splat: Model) -> None:
    """Write the Gaussians along a Z-order curve; the registry has refused thresholds."""
    splat = arrays.ordered(splat, arrays.morton_order(splat))
    count, starts = len(splat), np.arange(0, len(splat), _CHUNK)
    of = np.arange(count) // _CHUNK
    ranges: dict[str, npt.NDArray[Any]] = {}

    def packed(values: npt.NDArray[Any], what: str) -> npt.NDArray[Any]:
        low, high = np.minimum.reduceat(values, starts), np.maximum.reduceat(values, starts)
        for names, ends in zip(_names(what), (low, high), strict=True):
            ranges.update(zip(names, ends.T, strict=True))
        wide = np.where(high - low < 1e-5, np.inf, high - low)
        return (values - low[of]) / wide[of]

    xyz = _packed(packed(arrays.array(splat.xyz), "position"), (11, 10, 11))
    limited = np.clip(arrays.array(splat.scaling), -_SCALE_LIMIT, _SCALE_LIMIT)
    scales = _packed(packed(limited, "scale"), (11, 10, 11))
    rgb = packed(0.5 + arrays.SH_C0 * arrays.array(splat.f_dc)[:, 0], "colour")
    rgba = _packed(np.concatenate([rgb, arrays.opacities_of(splat)[:, None]], axis=1), (8, 8, 8, 8))
    vertex = np.stack([xyz, _packed_rotations(arrays.quaternions_of(splat)), scales, rgba], axis=1)
    rest = arrays.array(splat.f_rest).transpose(0, 2, 1).reshape(count, -1)
    sh = np.clip(np.trunc(256 * (rest / 8 + 0.5)), 0, 255).astype(np.uint8)
    lines = ["ply", "format binary_little_endian 1.0", f"element chunk {len(starts)}"]
    lines += [f"property float {name}" for name in ranges]
    lines += [f"element vertex {count}", *(f"property uint {name}" for name in _VERTEX)]
    if sh.shape[1]:
        lines += [f"element sh {count}"]
        lines += [f"property uchar f_rest_{i}" for i in range(sh.shape[1])]
    file.write("\n".join([*lines, "end_header\n"]).encode())
    for part in (np.stack(list(ranges.values()), axis=1).astype("<f4"), vertex.astype("<u4"), sh):
        file.write(np.ascontiguousarray(part).tobytes())


def _unpacked(packed: npt.NDArray[np.uint32], bits: tuple[int, ...]) -> npt.NDArray[Any]:
    """Fractions in [0, 1] of fields of so many bits, the first one highest."""
    fields, at = [], sum(bits)
    for width in bits:
        at -= width
        most = (1 << width) - 1
        fields.append(((packed >> np.uint32(at)) & np.uint32(most)) / most)
    return np.stack(fields, axis=1)


def _packed(fractions: npt.NDArray[Any], bits: tuple[int, ...]) -> npt.NDArray[np.uint32]:
    packed = np.zeros(len(fractions), np.uint32)
    for column, width in zip(fractions.T, bits, strict=True):
        most = (1 << width) - 1
        field = np.clip(np.floor(column.astype(np.float64) * most + 0.5), 0, most)
        packed = (packed << np.uint32(width)) | field.astype(np.uint32)
    return packed


def _rotations(packed: npt.NDArray[np.uint32]) -> npt.NDArray[Any]:
    """Quaternions from three components of 10 bits and the index of the largest."""
    three = (_unpacked(packed & np.uint32((1 << 30) - 1), (10, 10, 10)) - 0.5) / _HALF_SQRT2
    return arrays.with_largest(packed >> np.uint32(30), three)


def _packed_rotations(quaternions: npt.NDArray[Any]) -> npt.NDArray[np.uint32]:
    largest, three = arrays.without_largest(quaternions)
    packed = _packed(three * _HALF_SQRT2 + 0.5, (10, 10, 10))
    result: npt.NDArray[np.uint32] = packed | (largest.astype(np.uint32) << np.uint32(30))
    return result


FORMAT = Format(
    "compressed PLY",
    ".compressed.ply",
    read,
    write,
    keeps="positions and scales to 10 or 11 bits of the range of each 256 Gaussians, rotations to "
    "10 bits, opacities, colours and SH to 8 bits, and no cutoffs",
    claims=lies_at,
)
