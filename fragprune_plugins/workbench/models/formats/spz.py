"""SPZ of Niantic: versions 2 to 4 are read, version 4 is written.

Version 4 is a header of 32 bytes, extension records, a table of contents and one zstd stream for
each attribute; versions 2 and 3 are one gzip stream. Axes are the PLY's, as the converters of
Niantic and PlayCanvas leave them, unless the record ``SPZ_ADOBE_coordinate_system`` names others.
Thresholds are an extension record of ours (docs/reference/cutoff.md).
"""

from __future__ import annotations

import gzip
import io
import struct
import sys
from typing import Any, BinaryIO

import numpy as np
import numpy.typing as npt

from fragprune_plugins.errors import log
from fragprune_plugins.files.model import Model
from fragprune_plugins.files.reading import Reading
from fragprune_plugins.workbench.models.formats import Format, arrays

if sys.version_info >= (3, 14):
    from compression import zstd
else:
    from backports import zstd

CUTOFFS = 0x46500001  # our extension record: vendor 0x4650 (FP), 1; a code a Gaussian
STOP = 0x46500002  # likewise 2; its payload is the stop, float32
SOFT = 0x46500003  # likewise 3, of a model with a soft rim; no payload
_COORDINATES = 0xADBE0003  # SPZ_ADOBE_coordinate_system
_RDF = 6  # the PLY's axes among those that it names
_MAGIC = 0x5053474E
_HEADER = struct.Struct("<IIIBBBB")  # magic, version, points, SH degree, fraction bits, flags, n
_RECORD = struct.Struct("<II")
_ENTRY = struct.Struct("<QQ")
_ANTIALIASED, _EXTENDED = 0x1, 0x2  # bits of the flags
_FRACTION_BITS = 12
_COLOUR_SCALE = 0.15
_LEVEL = 12  # of zstd, as Niantic's writer has it
_NAMED = 8  # extensions in a warning
_SQRT_HALF = np.float32(0.5**0.5)


def read(reading: Reading) -> Model:
    """The Gaussians of an open file."""
    magic = reading.take(4)
    reading.file.seek(0)
    if magic[:2] == b"\x1f\x8b":
        with gzip.GzipFile(fileobj=reading.file) as stream:
            header = _Header(arrays.take(stream, 16), reading.size)
            if header.version not in (2, 3):
                raise ValueError(f"version {header.version} of SPZ in gzip")
            parts = [arrays.take(stream, size) for size in header.sizes]
            records = _records(stream.read(header.count + 4096)) if header.extended else {}
    else:
        header = _Header(reading.take(16), reading.size)
        if header.version != 4:
            raise ValueError(f"version {header.version} of SPZ")
        (start,) = struct.unpack("<I", reading.take(4))
        reading.take(12)
        if start < 32:
            raise ValueError(f"a table of contents at byte {start}")
        zone = reading.take(start - 32)
        records = _records(zone) if header.extended else {}
        parts = _streams(reading, header)
    if header.antialiased:
        log.warning("SPZ: it was trained with antialiasing, and is drawn as 3DGS draws, without")
    if unknown := records.keys() - {CUTOFFS, STOP, SOFT, _COORDINATES}:
        named = ", ".join(f"{each:#010x}" for each in sorted(unknown)[:_NAMED])
        log.warning("SPZ: skipped %d extension(s): %s", len(unknown), named)
    count, codes, stop = header.count, records.get(CUTOFFS), records.get(STOP)
    if codes is not None and len(codes) != count:
        raise ValueError(f"{len(codes)} thresholds for {count} Gaussians")
    columns = (np.frombuffer(part, np.uint8).reshape(count, -1) for part in parts)
    positions, alphas, colours, scales, rotations, sh = columns
    b = positions.reshape(count, 3, 3).astype(np.int32)
    fixed = b[..., 0] | b[..., 1] << 8 | b[..., 2] << 16
    fixed -= (fixed & 0x800000) << 1
    splat = arrays.splat_of(
        xyz=fixed / np.float32(1 << header.bits),
        colours=(colours / 255 - 0.5) / _COLOUR_SCALE,
        rest=((sh.astype(np.float32) - 128) / 128).reshape(count, -1, 3),
        opacities=alphas[:, 0] / 255,
        log_scales=scales / 16 - 10,
        rotations=_first_three(rotations) if header.version == 2 else _smallest_three(rotations),
        thresholds=None if codes is None else arrays.of_codes(np.frombuffer(codes, np.uint8)),
        stop=None if stop is None else float(f"{struct.unpack('<f', stop)[0]:.6g}"),  # as written
        rim="soft" if SOFT in records else "hard",
    )
    return arrays.turned(splat, _axes(records.get(_COORDINATES)))


class _Header:
    """What a header says: version, number of Gaussians, SH degree, and the sizes of the parts."""

    def __init__(self, data: bytes, size: int) -> None:
        fields = _HEADER.unpack(data)
        magic, self.version, self.count, degree, self.bits, flags, self.streams = fields
        if magic != _MAGIC:
            raise ValueError("it does not begin with 'NGSP'")
        if degree >= len(arrays.SH_RESTS):
            raise ValueError(f"SH degree {degree}, where we draw up to 3")
        if self.bits > 23:
            raise ValueError(f"{self.bits} bits of fraction in 24")
        self.extended, self.antialiased = bool(flags & _EXTENDED), bool(flags & _ANTIALIASED)
        widths = (9, 1, 3, 3, 3 if self.version == 2 else 4, 3 * arrays.SH_RESTS[degree])
        self.sizes = [self.count * width for width in widths]
        arrays.expect_plausible(self.count, size)


def _streams(reading: Reading, header: _Header) -> list[bytes]:
    """The decompressed parts of a file of version 4, from its table of contents on."""
    wanted = [size for size in header.sizes if size]
    if header.streams != len(wanted):
        raise ValueError(f"{header.streams} streams, where {len(wanted)} belong")
    table = [_ENTRY.unpack(reading.take(_ENTRY.size)) for _ in wanted]
    parts = []
    for (compressed, size), expected in zip(table, wanted, strict=True):
        if size != expected:
            raise ValueError(f"a stream of {size} bytes, where {expected} belong")
        with zstd.ZstdFile(io.BytesIO(reading.take(compressed))) as stream:
            parts.append(arrays.take(stream, size))
    return parts + [b""] * (len(header.sizes) - len(parts))


def _records(zone: bytes) -> dict[int, bytes]:
    """The payloads of extension records by type."""
    found: dict[int, bytes] = {}
    at = 0
    while at < len(zone):
        if at + _RECORD.size > len(zone):
            raise EOFError("an extension record that is cut off")
        kind, length = _RECORD.unpack_from(zone, at)
        at += _RECORD.size
        if at + length > len(zone):
            raise EOFError(f"an extension record of {length} bytes that is cut off")
        found.setdefault(kind, zone[at : at + length])
        at += length
    return found


def _axes(payload: bytes | None) -> tuple[int, int, int]:
    """The signs of axes by which a file's coordinates become the PLY's."""
    if payload is None:
        return (1, 1, 1)
    (system,) = struct.unpack("<I", payload)
    if not 1 <= system <= 8:
        raise ValueError(f"coordinate system {system}, which also exchanges axes")
    differ = (system - 1) ^ (_RDF - 1)
    x, y, z = (-1 if differ >> bit & 1 else 1 for bit in range(3))
    return x, y, z


def _first_three(data: arrays.Bytes) -> npt.NDArray[Any]:
    """Quaternions w, x, y, z of version 2: x, y, z in 8 bits, w >= 0."""
    xyz = data / 127.5 - 1
    return np.column_stack([np.sqrt(np.maximum(0, 1 - (xyz**2).sum(axis=1))), xyz])


def _smallest_three(data: arrays.Bytes) -> npt.NDArray[Any]:
    """Quaternions w, x, y, z of versions 3 and 4: index of the largest, and 9 bits and a sign."""
    packed = np.ascontiguousarray(data).view("<u4")[:, 0]
    largest = packed >> 30
    fields = np.stack([packed >> 20, packed >> 10, packed], axis=1) & 0x3FF
    three = _SQRT_HALF * (fields & 0x1FF) / 511 * np.where(fields & 0x200, -1, 1)
    return arrays.with_largest(largest, three)[:, [3, 0, 1, 2]]


def write(file: BinaryIO, splat: Model) -> None:
    """Write version 4; extension records are there only for thresholds that cut, and for rules."""
    xyz, sh, bits = arrays.array(splat.xyz), arrays.array(splat.f_rest), _FRACTION_BITS
    while bits and np.abs(xyz).max() * (1 << bits) >= (1 << 23) - 1:
        bits -= 1  # a scene wider than 2048 units
    fixed = _rounded(xyz * np.float32(1 << bits))
    if np.abs(fixed).max() >= 1 << 23:
        raise ValueError("positions beyond 8,388,607 units, which 24 bits do not hold")
    packed = fixed.astype("<i4").view(np.uint8).reshape(-1, 4)[:, :3]
    levels = np.where(np.arange(sh.shape[1]) < 3, 8, 16)[None, :, None]
    quantised = (_rounded(sh * 128).astype(np.int32) + 128 + levels // 2) // levels * levels
    parts = [
        packed,
        arrays.byte(arrays.opacities_of(splat) * 255),
        arrays.byte(
            arrays.array(splat.f_dc)[:, 0] * np.float32(_COLOUR_SCALE * 255) + np.float32(127.5)
        ),
        arrays.byte((arrays.array(splat.scaling) + 10) * 16),
        _packed_rotations(arrays.quaternions_of(splat)),
        np.clip(quantised, 0, 255).astype(np.uint8),
    ]
    streams = [np.ascontiguousarray(part).tobytes() for part in parts if part.size]
    codes = arrays.codes_of(splat)
    zone = b"" if codes is None else _RECORD.pack(CUTOFFS, len(codes)) + codes.tobytes()
    if splat.stop is not None:
        zone += _RECORD.pack(STOP, 4) + struct.pack("<f", splat.stop)
    if splat.rim == "soft":
        zone += _RECORD.pack(SOFT, 0)
    flags = _EXTENDED if zone else 0
    header = _HEADER.pack(_MAGIC, 4, len(splat), splat.sh_degree, bits, flags, len(streams))
    file.write(header + struct.pack("<I", 32 + len(zone)) + bytes(12) + zone)
    compressed = [zstd.compress(stream, level=_LEVEL) for stream in streams]
    for one, stream in zip(compressed, streams, strict=True):
        file.write(_ENTRY.pack(len(one), len(stream)))
    for one in compressed:
        file.write(one)


def _rounded(values: npt.NDArray[Any]) -> npt.NDArray[Any]:
    """To the nearest integer, halves away from zero, as C rounds."""
    rounded: npt.NDArray[Any] = np.copysign(np.floor(np.abs(values) + 0.5), values)
    return rounded


def _packed_rotations(quaternions: npt.NDArray[Any]) -> Any:
    largest, three = arrays.without_largest(quaternions[:, [1, 2, 3, 0]])
    sizes = np.floor(511 * (np.abs(three) / _SQRT_HALF) + np.float32(0.5)).astype(np.uint32)
    signs = np.signbit(three).astype(np.uint32)
    packed = largest.astype(np.uint32)
    for size, sign in zip(sizes.T, signs.T, strict=True):
        packed = packed << 10 | sign << 9 | size
    return packed.astype("<u4")


FORMAT = Format(
    "SPZ",
    ".spz",
    read,
    write,
    thresholds="to 8 bits",
    keeps="positions to 1/4096 of a unit (less if one is beyond 2,048), scales, opacities and "
    "colours to 8 bits, rotations to 9 bits and sign, SH to 5 bits (degree 1) and 4 bits",
)
