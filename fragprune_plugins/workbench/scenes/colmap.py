"""Reads COLMAP's sparse model: cameras and images, text or binary."""

from __future__ import annotations

import math
import os
import struct
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation
from torch import Tensor

from fragprune_plugins.errors import DatasetError, log, printable
from fragprune_plugins.files.reading import Reading, UntrustedFile
from fragprune_plugins.workbench.scenes.images import find_image
from fragprune_plugins.workbench.scenes.posed import Lens, Posed, split

NERFSTUDIOS = Path("colmap", "sparse", "0")

_FILE = UntrustedFile(
    DatasetError,
    "cut off or not COLMAP's",
    "COLMAP's cameras and images files, complete",
    "Export the model again (colmap model_converter).",
    missing="Copy both files from COLMAP's model.",
)

_NAME_MAX = 4096  # bytes of an image's name

# COLMAP's camera models by their number, src/colmap/sensor/models.h: how many focal lengths, and
# how many parameters after cx, cy. These are in OpenCV's order: k1, k2, p1, p2, k3, k4, k5, k6; of
# a fisheye k1, k2, k3, k4.
_MODELS = {
    0: ("SIMPLE_PINHOLE", 1, 0),
    1: ("PINHOLE", 2, 0),
    2: ("SIMPLE_RADIAL", 1, 1),
    3: ("RADIAL", 1, 2),
    4: ("OPENCV", 2, 4),
    5: ("OPENCV_FISHEYE", 2, 4),
    6: ("FULL_OPENCV", 2, 8),
    7: ("FOV", 2, 1),
    8: ("SIMPLE_RADIAL_FISHEYE", 1, 1),
    9: ("RADIAL_FISHEYE", 1, 2),
    10: ("THIN_PRISM_FISHEYE", 2, 8),
    11: ("RAD_TAN_THIN_PRISM_FISHEYE", 2, 12),
    12: ("SIMPLE_DIVISION", 1, 1),
    13: ("DIVISION", 2, 1),
}
_OPENCV = {name: n for code, (name, *n) in _MODELS.items() if code not in (7, 10, 11, 12, 13)}
"""Those that OpenCV can straighten."""

Pose = tuple[str, int, tuple[float, ...], tuple[float, ...]]  # name, camera, w x y z, translation


def find_model(folder: Path) -> Path | None:
    """The folder with the cameras and images files; None if there is none.

    sparse/0 or sparse, as COLMAP and the hosts have it; else colmap/sparse/0, as nerfstudio has.
    """
    for candidate in (folder / "sparse" / "0", folder / "sparse", folder / NERFSTUDIOS):
        if any(os.path.exists(candidate / f"images.{kind}") for kind in ("bin", "txt")):
            return candidate
    return None


def others(folder: Path) -> list[Path]:
    """The folders of sparse/1, sparse/2, ... of a scene that COLMAP could not join; by number."""
    inside = (folder / "sparse").glob("[1-9]*")
    return sorted(each for each in inside if _images_file(each).exists())


def _images_file(model: Path) -> Path:
    """A model's list of images. Binary first, as hosts do: COLMAP writes it; text is an export."""
    binary = model / "images.bin"
    return binary if binary.exists() else model / "images.txt"


def read(folder: Path, images: str = "images") -> tuple[list[Posed], list[Posed]]:
    """Read training and held-out views of a folder in which ``find_model`` finds something."""
    model = find_model(folder)
    assert model is not None
    listed = _images_file(model)
    binary = listed.suffix == ".bin"
    parsers = (_cameras_binary, _images_binary) if binary else (_cameras_text, _images_text)
    sizes = {each: _images_file(each).stat().st_size for each in (model, *others(folder))}
    other = max(sizes, key=sizes.__getitem__)  # of equal ones the model
    if model == folder / "sparse" / "0" and other != model:
        log.warning(
            "%s: reading sparse/0, as hosts do, but %s is a larger part of the scene: its "
            "photographs are not in the figures. If the model was trained on them, exchange both",
            *(printable(str(folder)), printable(str(other))),
        )
    with _FILE.reading(listed.with_stem("cameras")) as reading:
        cameras = dict(parsers[0](reading))
    rows = []
    with _FILE.reading(listed) as reading:
        for given, camera_id, quaternion, translation in parsers[1](reading):
            name = given.replace("\\", "/")  # of a model made on Windows
            if camera_id not in cameras:
                found = f"image {name} of camera {camera_id}"
                expected = f"one of the cameras {sorted(cameras)[:20]}"
                remedy = "Export images and cameras from the same COLMAP model."
                raise DatasetError(str(model), found, expected, remedy)
            place = torch.tensor(translation, dtype=torch.float64)
            lens, mask = cameras[camera_id], _mask_path(folder / "masks", name)
            camera = lens.camera(_rotation(quaternion), place)
            image = find_image(folder / images / name)
            if not image.exists():  # hosts leave out the subfolders that a name may have
                image = find_image(folder / images / Path(name).name)
            rows.append(Posed(name, camera, image, None if lens.straight else lens, mask))
    return split(rows)


def points(folder: Path) -> NDArray[np.float64]:
    """(P, 3) the points of a scene; (0, 3) of a folder without any."""
    model = find_model(folder)
    files = [model / f"points3D.{kind}" for kind in ("bin", "txt")] if model else []
    for file in (each for each in files if each.exists()):
        with _FILE.reading(file) as reading:
            rows = (_points_binary if file.suffix == ".bin" else _points_text)(reading)
            return np.array([*rows], dtype=np.float64).reshape(-1, 3)
    return np.zeros((0, 3))


def _mask_path(masks: Path, name: str) -> Path | None:
    """The image's mask, named as COLMAP names it (with .png at the end) or as the image."""
    named = masks / f"{name}.png"
    found = named if named.exists() else find_image(masks / name)
    return found if found.exists() else None


def _rotation(quaternion: tuple[float, ...]) -> Tensor:
    """(3, 3) float64 rotation from a quaternion w, x, y, z of any length but 0."""
    length = math.hypot(*quaternion)
    if not 0 < length < math.inf:
        raise ValueError(f"the quaternion {list(quaternion)}, which is no rotation")
    w, *xyz = (each / length for each in quaternion)
    return torch.from_numpy(Rotation.from_quat([*xyz, w]).as_matrix())


def _lens(model: str, width: int, height: int, values: Sequence[float]) -> Lens:
    """A lens by COLMAP's parameters of a model."""
    if model not in _OPENCV:
        found, remedy = f"model {model}", "Undistort first: colmap image_undistorter."
        raise DatasetError("COLMAP camera", found, f"one of {', '.join(_OPENCV)}", remedy)
    focals, bends = _OPENCV[model]
    if len(values) != focals + 2 + bends:
        raise ValueError(f"{len(values)} parameters of {model}, not {focals + 2 + bends}")
    cx, cy, *bend = values[focals:]
    fisheye = model.endswith("FISHEYE")
    bend += [0.0] * ((4 if fisheye else 8) - bends)
    return Lens(width, height, values[0], values[focals - 1], cx, cy, tuple(bend), fisheye)


def _text_lines(reading: Reading) -> Iterator[str]:
    """The lines of a text file that are no comments; empty ones too."""
    for number, line in enumerate(reading.file, start=1):
        reading.place = f"line {number}"
        if not (text := line.decode("utf-8-sig")).startswith("#"):
            yield text


def _cameras_text(reading: Reading) -> Iterator[tuple[int, Lens]]:
    for line in _text_lines(reading):
        if line.strip():
            number, model, width, height, *values = line.split()
            numbers = [float(value) for value in values]
            yield int(number), _lens(model, int(width), int(height), numbers)


def _images_text(reading: Reading) -> Iterator[Pose]:
    # Two lines an image; the second, its 2D points, may be empty.
    lines = _text_lines(reading)
    for line in lines:
        if line.strip():
            fields = line.split(maxsplit=9)
            numbers = tuple(float(value) for value in fields[1:8])
            yield fields[9].strip(), int(fields[8]), numbers[:4], numbers[4:]
            if (points := len(next(lines, "").split())) % 3:
                raise ValueError(f"{points} words where an image's 2D points belong: x, y, id each")


def _unpack(reading: Reading, layout: str) -> tuple[Any, ...]:
    return struct.unpack("<" + layout, reading.take(struct.calcsize("<" + layout)))


def _announced(reading: Reading, least: int) -> Iterator[int]:
    """Count through what the next number announces, of at least so many bytes each."""
    count = _unpack(reading, "Q")[0]
    if count * least > reading.left:
        raise EOFError(f"{count} announced, in {reading.left} bytes")
    for number in range(count):
        reading.place = f"number {number + 1} of {count}, byte {reading.file.tell()}"
        yield number


def _cameras_binary(reading: Reading) -> Iterator[tuple[int, Lens]]:
    for _ in _announced(reading, least=24):
        number, code, width, height = _unpack(reading, "iiQQ")
        if code not in _MODELS:
            raise ValueError(f"camera model number {code}")
        model, focals, bends = _MODELS[code]
        values = _unpack(reading, f"{focals + 2 + bends}d")
        yield number, _lens(model, width, height, values)


def _images_binary(reading: Reading) -> Iterator[Pose]:
    for _ in _announced(reading, least=73):
        _number, *numbers, camera_id = _unpack(reading, "i7di")
        name = _name(reading)
        reading.skip(24 * _unpack(reading, "Q")[0])  # 2D points: x, y, id
        yield name, camera_id, tuple(numbers[:4]), tuple(numbers[4:])


def _points_text(reading: Reading) -> Iterator[tuple[float, ...]]:
    for line in _text_lines(reading):
        if line.strip():
            yield tuple(float(value) for value in line.split(maxsplit=4)[1:4])


def _points_binary(reading: Reading) -> Iterator[tuple[float, ...]]:
    for _ in _announced(reading, least=51):
        _number, *xyz = _unpack(reading, "Q3d")
        reading.skip(11)  # colour, error
        reading.skip(8 * _unpack(reading, "Q")[0])  # where it was seen: image, 2D point
        yield tuple(xyz)


def _name(reading: Reading) -> str:
    """A name that a zero byte ends."""
    begin = reading.file.tell()
    name, zero, _ = reading.file.read(_NAME_MAX).partition(b"\0")
    if not zero:
        raise ValueError(f"a name without end at byte {begin}")
    reading.file.seek(begin + len(name) + 1)
    return name.decode("utf-8")
