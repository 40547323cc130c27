"""SOG of PlayCanvas, version 2: WebP images, one texel a Gaussian, and ``meta.json``.

A ``.sog`` file is a zip of them; a ``meta.json`` beside its images is read too. Thresholds are an
image more, which ``extras`` in ``meta.json`` names (docs/reference/cutoff.md).
"""

from __future__ import annotations

import io
import json
import math
import warnings
import zipfile
from collections.abc import Callable
from pathlib import Path
from typing import Any, BinaryIO

import numpy as np
import numpy.typing as npt
from PIL import Image

from fragprune_plugins.constants import VERSION
from fragprune_plugins.errors import ModelFileError, log
from fragprune_plugins.files.model import Model
from fragprune_plugins.files.reading import MEBIBYTE, Reading, UntrustedFile, parse_json
from fragprune_plugins.workbench.models.formats import Format, arrays
from fragprune_plugins.workbench.models.formats.palette import codebook, nearest, palette

EXTRA = "fragprune_cutoff"  # in ``extras``; its one file's red channel holds a code a texel
_META = "meta.json"
_META_MAX = 4 * MEBIBYTE
_SIDE_MAX = 16383  # of a WebP
_PALETTE = 64  # entries in a row of the image of SH
_SQRT2 = 2**0.5
_FILE = UntrustedFile(
    ModelFileError, "not readable as WebP", "an image of a SOG", "Copy the model again."
)

Load = Callable[[str], bytes]


def read(reading: Reading) -> Model:
    """The Gaussians of an open ``.sog``, or of an open ``meta.json`` and the images beside it."""
    if reading.path.name == _META:
        return _read(parse_json(reading.take(_bounded(reading.size)).decode()), _beside(reading))
    with zipfile.ZipFile(reading.file) as archive:

        def load(name: str) -> bytes:
            info = archive.getinfo(name)
            if info.compress_type not in (zipfile.ZIP_STORED, zipfile.ZIP_DEFLATED):
                raise ValueError(f"compression {info.compress_type} of {name}")  # unpacks at once
            if info.file_size > reading.size + _META_MAX:  # WebP gets no smaller in a zip
                raise ValueError(f"{info.file_size} bytes in {name}")
            with archive.open(info) as member:
                return arrays.take(member, info.file_size)

        _bounded(archive.getinfo(_META).file_size)
        return _read(parse_json(load(_META).decode()), load)


def _bounded(size: int) -> int:
    if size > _META_MAX:
        raise ValueError(f"{size} bytes in {_META}")
    return size


def _beside(reading: Reading) -> Load:
    """Loads images from the folder of ``meta.json``, and from nowhere else."""

    def load(name: str) -> bytes:
        if Path(name).name != name:
            raise ValueError(f"an image at {name[:80]!r}")
        with _FILE.reading(reading.path.parent / name) as image:
            return image.take(image.size)

    return load


def _read(meta: dict[str, Any], load: Load) -> Model:
    if meta.get("version") != 2:
        raise ValueError(f"version {meta.get('version')!r} of SOG")
    count = meta["count"]
    if not isinstance(count, int):
        raise ValueError(f"{count!r} Gaussians")
    arrays.expect_plausible(count, len(load(meta["means"]["files"][0])))
    if (kind := meta.get("model", "default")) != "default":
        log.warning("SOG: its training model is %.40r, and is drawn as 3DGS draws", kind)

    def image(part: dict[str, Any], index: int = 0) -> arrays.Bytes:
        return _pixels(load(part["files"][index]), count).reshape(-1, 4)[:count]

    means, scales, base = meta["means"], meta["scales"], meta["sh0"]
    low, high = (np.array(means[end], np.float64).reshape(3) for end in ("mins", "maxs"))
    fine, coarse = (image(means, index)[:, :3].astype(np.uint16) for index in range(2))
    logs = low + (high - low) * ((fine | coarse << 8) / 65535)
    with np.errstate(over="ignore"):
        xyz = np.sign(logs) * np.expm1(np.abs(logs))
    rgba = image(base)
    extra = meta.get("extras", {}).get(EXTRA, {})
    return arrays.splat_of(
        xyz=xyz,
        colours=_book(base)[rgba[:, :3]],
        rest=_rest(meta.get("shN"), load, image, count),
        opacities=rgba[:, 3] / 255,
        log_scales=_book(scales)[image(scales)[:, :3]],
        rotations=_rotations(image(meta["quats"])),
        thresholds=arrays.of_codes(image(extra)[:, 0]) if "files" in extra else None,
        stop=extra.get("stop"),
        rim=extra.get("rim", "hard"),
    )


def _pixels(data: bytes, count: int) -> arrays.Bytes:
    """The pixels of a WebP (height, width, 4), which has to have a texel for each Gaussian."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", Image.DecompressionBombWarning)  # the count decides
        with Image.open(io.BytesIO(data), formats=["WEBP"]) as picture:
            width, height = picture.size
            if not count <= width * height <= 2 * count + 4096:
                raise ValueError(f"an image of {width}x{height} for {count} texels")
            return np.asarray(picture.convert("RGBA"))


def _book(part: dict[str, Any]) -> npt.NDArray[np.float32]:
    """A codebook of 256 values."""
    values = np.array(part["codebook"], np.float32).reshape(-1)
    return np.resize(values, 256) if len(values) < 256 else values[:256]


def _rest(
    part: dict[str, Any] | None, load: Load, image: Callable[..., arrays.Bytes], count: int
) -> npt.NDArray[Any]:
    """The SH of degrees 1 and more (N, K - 1, 3): labels, palette, codebook."""
    if part is None:
        return np.zeros((count, 0, 3), np.float32)
    bands, size = part["bands"], part["count"]
    if bands not in (1, 2, 3) or not isinstance(size, int) or not 0 < size <= 1 << 16:
        raise ValueError(f"a palette of {size!r} for {bands!r} bands")
    wide = arrays.SH_RESTS[bands]
    pixels = _pixels(load(part["files"][0]), _PALETTE * wide * -(-size // _PALETTE))
    if pixels.shape[1] != _PALETTE * wide:
        raise ValueError(f"a palette {pixels.shape[1]} wide for {bands} bands")
    entries = pixels[:, :, :3].reshape(-1, wide, 3)[:size]
    labels = image(part, 1)[:, :2].astype(np.int64) @ np.array([1, 256])
    if len(entries) < size or labels.max() >= size:
        raise ValueError("labels beyond the palette")
    rest: npt.NDArray[Any] = _book(part)[entries[labels]]
    return rest


def _rotations(texels: arrays.Bytes) -> npt.NDArray[Any]:
    """Quaternions w, x, y, z: three components of 8 bits, and which one is the largest."""
    largest = texels[:, 3].astype(np.int64) - 252
    if (largest < 0).any():
        raise ValueError("rotations without a largest component")
    return arrays.with_largest(largest, (texels[:, :3] / 255 * 2 - 1) / _SQRT2)


def write(file: BinaryIO, splat: Model) -> None:
    """Write a bundle along a Z-order curve; the extra image is there only if it cuts something."""
    order, codes, extra = arrays.morton_order(splat), arrays.codes_of(splat), arrays.rules_of(splat)
    splat = arrays.ordered(splat.untruncated(), order)
    count = len(splat)
    width = 4 * math.ceil(count**0.5 / 4)
    height = 4 * math.ceil(count / width / 4)
    if max(width, height) > _SIDE_MAX:
        raise ValueError(f"{count} Gaussians, more than the images of a SOG hold")
    files: dict[str, bytes] = {}

    def plane(name: str, columns: npt.NDArray[Any]) -> list[str]:
        """Add an image of (N, 3 or 4) bytes; returns its name as ``files`` has it."""
        texels = np.zeros((width * height, 4), np.uint8)
        texels[:, 3] = 255
        texels[:count, : columns.shape[1]] = columns
        files[name] = _webp(texels.reshape(height, width, 4))
        return [name]

    xyz = arrays.array(splat.xyz).astype(np.float64)
    logs = np.sign(xyz) * np.log1p(np.abs(xyz))
    low, high = logs.min(axis=0), logs.max(axis=0)
    steps = np.floor(65535 * (logs - low) / np.where(high > low, high - low, 1) + 0.5)
    fine, coarse = (steps.astype(np.uint16) >> shift & 0xFF for shift in (0, 8))
    scales, base = arrays.array(splat.scaling), arrays.array(splat.f_dc)[:, 0]
    books = [codebook(values) for values in (scales, base)]
    rgb = nearest(books[1], base)
    rgba = np.concatenate([rgb, arrays.byte(255 * arrays.opacities_of(splat))[:, None]], axis=1)
    meta: dict[str, Any] = {
        "version": 2,
        "asset": {"generator": f"fragprune v{VERSION}"},
        "count": count,
        "means": {
            "mins": low.tolist(),
            "maxs": high.tolist(),
            "files": plane("means_l.webp", fine) + plane("means_u.webp", coarse),
        },
        "scales": {
            "codebook": books[0].tolist(),
            "files": plane("scales.webp", nearest(books[0], scales)),
        },
        "quats": {"files": plane("quats.webp", _packed_rotations(arrays.quaternions_of(splat)))},
        "sh0": {"codebook": books[1].tolist(), "files": plane("sh0.webp", rgba)},
    }
    if splat.sh_degree:
        rest = arrays.array(splat.f_rest)
        entries, labels = palette(rest.reshape(count, -1))
        book, wide = codebook(entries), rest.shape[1]
        tall = -(-len(entries) // _PALETTE)
        texels = np.full((tall * _PALETTE, wide, 4), 255, np.uint8)
        texels[: len(entries), :, :3] = nearest(book, entries).reshape(-1, wide, 3)
        files["shN_centroids.webp"] = _webp(texels.reshape(tall, _PALETTE * wide, 4))
        two = np.stack([labels & 0xFF, labels >> 8, np.zeros_like(labels)], axis=1)
        meta["shN"] = {
            "count": len(entries),
            "bands": splat.sh_degree,
            "codebook": book.tolist(),
            "files": ["shN_centroids.webp", *plane("shN_labels.webp", two)],
        }
    if codes is not None:
        grey = np.repeat(codes[order.numpy(), None], 3, axis=1)
        extra["files"] = plane(f"{EXTRA}.webp", grey)
    if extra:
        meta["extras"] = {EXTRA: extra}
    files[_META] = json.dumps(meta, separators=(",", ":")).encode()
    with zipfile.ZipFile(file, "w", zipfile.ZIP_STORED) as archive:
        for name, content in files.items():
            archive.writestr(zipfile.ZipInfo(name), content)  # of 1980: the same bytes every time


def _packed_rotations(quaternions: npt.NDArray[Any]) -> arrays.Bytes:
    largest, three = arrays.without_largest(quaternions)
    packed = arrays.byte(255 * (three * _SQRT2 * 0.5 + 0.5))
    return np.concatenate([packed, (252 + largest).astype(np.uint8)[:, None]], axis=1)


def _webp(pixels: arrays.Bytes) -> bytes:
    out = io.BytesIO()
    # exact: also the colours of texels whose opacity is 0
    Image.fromarray(pixels).save(out, "WEBP", lossless=True, exact=True)
    return out.getvalue()


FORMAT = Format(
    "SOG",
    ".sog",
    read,
    write,
    thresholds="to 8 bits",
    keeps="positions to 16 bits of their logarithm, rotations and opacities to 8 bits, scales "
    "and colours to 256 values each, SH to a palette of up to 65,536",
)
