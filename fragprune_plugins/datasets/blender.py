"""Reads Blender's layout, transforms_train.json and transforms_test.json (NeRF synthetic)."""

from __future__ import annotations

import math
from pathlib import Path
from typing import Any

import torch

from fragprune_plugins.datasets.images import image_size
from fragprune_plugins.datasets.pinhole import Camera
from fragprune_plugins.errors import DatasetError
from fragprune_plugins.storage.reading import MEBIBYTE, Door

Row = tuple[str, Camera, Path]
"""name, camera, image file"""

_DISTORTION = ("k1", "k2", "k3", "k4", "k5", "k6", "p1", "p2")

_JSON_MAX = 256 * MEBIBYTE

_JSON = Door(
    DatasetError,
    "not readable as JSON",
    "a JSON file of cameras",
    "Save it again.",
    limit=_JSON_MAX,
)
_TRANSFORMS = Door(
    DatasetError,
    "not a transforms file",
    "frames with file_path and transform_matrix, and camera_angle_x or fl_x",
    "Export it again.",
)


def read(folder: Path) -> tuple[list[Row], list[Row]]:
    """Read training and held-out views: name, camera, image path.

    Raises:
        DatasetError: a file or image is missing or broken, or the lens has distortion.
    """
    train, test = (
        read_transforms(folder / f"transforms_{part}.json") for part in ("train", "test")
    )
    return train, test


def read_transforms(path: Path) -> list[Row]:
    """Read the views of one transforms file.

    Intrinsics are ``fl_x, fl_y, cx, cy`` where given, else ``camera_angle_x`` and a centred
    principal point; ``w, h`` where given, else the size of the image.

    Raises:
        DatasetError: see ``read``.
    """
    content = load_json(path)
    with _TRANSFORMS.stated(path) as reading:
        distortion = [key for key in _DISTORTION if float(content.get(key, 0)) != 0]
        distortion += ["fisheye"] if "FISHEYE" in str(content.get("camera_model", "")) else []
        if distortion or content.get("is_fisheye"):
            raise DatasetError(
                str(path),
                f"lens distortion ({', '.join(distortion) or 'fisheye'})",
                "undistorted images: rasterization has no lens distortion",
                "Undistort them first (colmap image_undistorter).",
            )
        rows = []
        for number, frame in enumerate(content["frames"]):
            reading.place = f"frames[{number}]"
            rows.append(_row(path.parent, content, frame))
        return rows


def load_json(path: Path) -> Any:
    """Read a JSON file.

    Raises:
        DatasetError: the file is missing or not JSON.
    """
    with _JSON.reading(path) as reading:
        return reading.json()


def matrix(values: Any, *shapes: tuple[int, ...]) -> torch.Tensor:
    """Nested lists of numbers as float64, in one of the shapes; raises ValueError."""
    found = torch.tensor(values, dtype=torch.float64)
    if tuple(found.shape) not in shapes:
        raise ValueError(
            f"numbers of shape {tuple(found.shape)}, not {' or '.join(map(str, shapes))}"
        )
    return found


def _row(folder: Path, content: dict[str, Any], frame: dict[str, Any]) -> Row:
    image = folder / frame["file_path"]
    if not image.is_file():
        image = image.with_name(image.name + ".png")  # these files name images without extension
    width, height = (int(content["w"]), int(content["h"])) if "w" in content else image_size(image)
    fx = (
        float(content["fl_x"])
        if "fl_x" in content
        else width / (2 * math.tan(float(content["camera_angle_x"]) / 2))
    )
    pose = matrix(frame["transform_matrix"], (4, 4), (3, 4))[:3]
    to_world = pose[:, :3] * torch.tensor([1.0, -1.0, -1.0])  # OpenGL's y up, z back, to COLMAP's
    rotation = to_world.T.contiguous()
    camera = Camera(
        rotation,
        -rotation @ pose[:, 3],
        width,
        height,
        fx,
        float(content.get("fl_y", fx)),
        float(content.get("cx", width / 2)),
        float(content.get("cy", height / 2)),
    )
    return image.name.rsplit(".", 1)[0], camera, image
