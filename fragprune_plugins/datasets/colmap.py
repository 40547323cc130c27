"""Reads COLMAP's sparse model: cameras and images, text or binary."""

from __future__ import annotations

import struct
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any, BinaryIO, TypeVar

import torch
from torch import Tensor

from fragprune_plugins.datasets.pinhole import Camera
from fragprune_plugins.errors import DatasetError

HOLD_OUT = 8
"""Views 0, 8, 16, ... of the sorted names are held out (hosts' llffhold)."""

Row = tuple[str, Camera, Path]
"""name, camera, image file"""

Parsed = TypeVar("Parsed")

# COLMAP's numbers for camera models, src/colmap/sensor/models.h, with their parameter counts.
_MODELS = {
    0: ("SIMPLE_PINHOLE", 3),
    1: ("PINHOLE", 4),
    2: ("SIMPLE_RADIAL", 4),
    3: ("RADIAL", 5),
    4: ("OPENCV", 8),
    5: ("OPENCV_FISHEYE", 8),
    6: ("FULL_OPENCV", 12),
    7: ("FOV", 5),
    8: ("SIMPLE_RADIAL_FISHEYE", 4),
    9: ("RADIAL_FISHEYE", 5),
    10: ("THIN_PRISM_FISHEYE", 12),
}

Intrinsics = tuple[int, int, float, float, float, float]
"""width, height, fx, fy, cx, cy"""

Pose = tuple[str, int, tuple[float, ...], tuple[float, ...]]
"""name, camera id, quaternion w x y z, translation"""


def find_model(folder: Path) -> Path | None:
    """The folder with the cameras and images files: sparse/0 or sparse; None if neither."""
    for candidate in (folder / "sparse" / "0", folder / "sparse"):
        if any((candidate / f"images.{kind}").exists() for kind in ("bin", "txt")):
            return candidate
    return None


def read(folder: Path, images: str = "images") -> tuple[list[Row], list[Row]]:
    """Read training and held-out views: name, camera, image path.

    Args:
        folder: the scene.
        images: name of the folder with the images.

    Raises:
        DatasetError: a file is broken, a camera has distortion, or an image has no camera.
    """
    model = find_model(folder)
    assert model is not None, "the caller looked"
    # Binary first, as hosts do: COLMAP writes binary files, and text files are an export.
    if (model / "images.bin").exists():
        cameras = _parsed(model / "cameras.bin", _cameras_binary)
        poses = _parsed(model / "images.bin", _images_binary)
    else:
        cameras = _parsed(model / "cameras.txt", _cameras_text)
        poses = _parsed(model / "images.txt", _images_text)
    rows = []
    for name, camera_id, quaternion, translation in poses:
        if camera_id not in cameras:
            raise DatasetError(
                str(model),
                f"image {name} of camera {camera_id}",
                f"one of the cameras {sorted(cameras)}",
                "Export images and cameras from the same COLMAP model.",
            )
        width, height, fx, fy, cx, cy = cameras[camera_id]
        camera = Camera(
            _rotation(quaternion),
            torch.tensor(translation, dtype=torch.float64),
            width,
            height,
            fx,
            fy,
            cx,
            cy,
        )
        rows.append((name, camera, _image_path(folder / images, name)))
    rows.sort(key=lambda row: Path(row[0]).stem)
    train = [row for index, row in enumerate(rows) if index % HOLD_OUT]
    return train, rows[::HOLD_OUT]


def _image_path(images: Path, name: str) -> Path:
    """The image's path, by its base name as hosts do; COLMAP's name may include subfolders."""
    full = images / name
    return full if full.exists() else images / Path(name).name


def _rotation(quaternion: tuple[float, ...]) -> Tensor:
    """(3, 3) float64 rotation from a quaternion w, x, y, z of any length."""
    q = torch.tensor(quaternion, dtype=torch.float64)
    w, x, y, z = (q / q.norm()).tolist()
    return torch.tensor(
        [
            [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
            [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
            [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
        ],
        dtype=torch.float64,
    )


def _parsed(path: Path, parse: Callable[[BinaryIO], Parsed]) -> Parsed:
    try:
        with open(path, "rb") as file:
            return parse(file)
    except FileNotFoundError as error:
        raise DatasetError(
            str(path), "no such file", "COLMAP's cameras and images files", "Copy both."
        ) from error
    except (struct.error, ValueError, IndexError, UnicodeDecodeError) as error:
        raise DatasetError(
            str(path),
            f"cut off or not COLMAP's ({error})",
            "a complete COLMAP file",
            "Export the model again (colmap model_converter).",
        ) from error


def _intrinsics(model: str, width: int, height: int, values: Sequence[float]) -> Intrinsics:
    if model == "PINHOLE":
        fx, fy, cx, cy = values
        return width, height, fx, fy, cx, cy
    if model == "SIMPLE_PINHOLE":
        f, cx, cy = values
        return width, height, f, f, cx, cy
    raise DatasetError(
        "COLMAP camera",
        f"model {model}",
        "PINHOLE or SIMPLE_PINHOLE: rasterization has no lens distortion",
        "Undistort first: colmap image_undistorter.",
    )


def _text_lines(file: BinaryIO) -> list[str]:
    lines = file.read().decode("utf-8").splitlines()
    return [line for line in lines if not line.startswith("#")]


def _cameras_text(file: BinaryIO) -> dict[int, Intrinsics]:
    cameras = {}
    for line in _text_lines(file):
        if line.strip():
            number, model, width, height, *values = line.split()
            cameras[int(number)] = _intrinsics(
                model, int(width), int(height), [float(value) for value in values]
            )
    return cameras


def _images_text(file: BinaryIO) -> list[Pose]:
    poses = []
    # Two lines an image; the second, its 2D points, may be empty.
    for line in _text_lines(file)[::2]:
        if line.strip():
            fields = line.split(maxsplit=9)
            numbers = tuple(float(value) for value in fields[1:8])
            poses.append((fields[9].strip(), int(fields[8]), numbers[:4], numbers[4:]))
    return poses


def _unpack(file: BinaryIO, layout: str) -> tuple[Any, ...]:
    return struct.unpack("<" + layout, file.read(struct.calcsize("<" + layout)))


def _cameras_binary(file: BinaryIO) -> dict[int, Intrinsics]:
    cameras = {}
    for _ in range(_unpack(file, "Q")[0]):
        number, code, width, height = _unpack(file, "iiQQ")
        if code not in _MODELS:
            raise ValueError(f"camera model number {code}")
        model, count = _MODELS[code]
        cameras[number] = _intrinsics(model, width, height, _unpack(file, f"{count}d"))
    return cameras


def _images_binary(file: BinaryIO) -> list[Pose]:
    poses = []
    for _ in range(_unpack(file, "Q")[0]):
        _number, *numbers, camera_id = _unpack(file, "i7di")
        name = bytearray()
        while (byte := _unpack(file, "c")[0]) != b"\0":
            name += byte
        points = _unpack(file, "Q")[0]
        if len(file.read(24 * points)) != 24 * points:
            raise ValueError("2D points end early")
        poses.append((name.decode("utf-8"), camera_id, tuple(numbers[:4]), tuple(numbers[4:])))
    return poses
