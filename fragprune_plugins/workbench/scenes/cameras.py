"""Cameras without their photographs: of a scene folder, or of one of three kinds of file.

These are the ``cameras.json`` a host writes beside its model (rotation is camera to world, the
principal point centred), a transforms file, and the ``camera_path.json`` that nerfstudio's viewer
saves (``camera_to_world`` of 16 numbers in OpenGL's axes, ``fov`` of the height in degrees).
"""

from __future__ import annotations

import math
from dataclasses import replace
from pathlib import Path
from typing import Any

import torch

from fragprune_plugins.errors import DatasetError
from fragprune_plugins.files.reading import UntrustedFile
from fragprune_plugins.hosts.photographs import Resolution
from fragprune_plugins.types import View
from fragprune_plugins.workbench.scenes import dataset, pinhole, posed, transforms
from fragprune_plugins.workbench.scenes.transforms import matrix

_CAMERAS = UntrustedFile(
    DatasetError,
    "not a cameras file",
    "cameras.json of a 3DGS model, or a transforms file",
    "Pass the cameras.json that a training wrote.",
)


def load_cameras(path: str | Path, *, white_background: bool = False) -> list[tuple[str, View]]:
    """Read the named views of a cameras file; DatasetError if it is missing, broken or empty."""
    path = Path(path)
    content = transforms.load_json(path)
    if isinstance(content, dict) and "camera_path" in content:
        with _CAMERAS.stated(path) as reading:
            if (kind := content.get("camera_type", "perspective")) != "perspective":
                raise ValueError(f"a path of {str(kind)[:40]!r} cameras, where we draw perspective")
            width, height = int(content["render_width"]), int(content["render_height"])
            cameras = []
            for number, entry in enumerate(content["camera_path"]):
                reading.place = f"camera_path[{number}]"
                pose = [entry["camera_to_world"][at : at + 4] for at in (0, 4, 8)]
                length = pinhole.focal(height, math.radians(float(entry["fov"])))
                lens = length, length, width / 2, height / 2
                placed = transforms.opengl_pose(matrix(pose, (3, 4)))
                camera = pinhole.Camera(*placed, width, height, *lens)
                cameras.append((f"{number:05d}", camera))
    elif isinstance(content, dict):
        cameras = [(row.name, row.camera) for row in transforms.read_transforms(path)]
    else:
        cameras = []
        with _CAMERAS.stated(path) as reading:
            for number, entry in enumerate(content):
                reading.place = f"[{number}]"
                cameras.append((str(entry["img_name"]), _camera(entry)))
    if not cameras:
        raise DatasetError(str(path), "0 cameras", "at least one", "Pass another file.")
    background = torch.full((3,), float(white_background))
    return [(name, camera.view(background)) for name, camera in cameras]


def load_scene_cameras(
    folder: Path, *, white_background: bool = False
) -> tuple[list[tuple[str, View]], list[tuple[str, View]]]:
    """Read the named training and held-out views of a scene folder, at their cameras' own sizes."""
    background = torch.full((3,), float(white_background))
    parts = dataset.read_scene(folder, split=False)
    if not all(parts):  # of a single one there is none to learn from
        parts = posed.hold_out([*parts[0], *parts[1]])
    train, test = ([(row.name, row.camera.view(background)) for row in part] for part in parts)
    return train, test


def sized(views: list[tuple[str, View]], size: Resolution) -> list[tuple[str, View]]:
    """The same views with pictures of the size at which photographs are read."""
    found = []
    for name, view in views:
        width, height = size.of(view.width, view.height)
        found.append((name, replace(view, width=width, height=height)))
    return found


def _camera(entry: dict[str, Any]) -> pinhole.Camera:
    rotation = matrix(entry["rotation"], (3, 3)).T.contiguous()
    position = matrix(entry["position"], (3,))
    width, height = int(entry["width"]), int(entry["height"])
    lens = float(entry["fx"]), float(entry["fy"]), width / 2, height / 2
    return pinhole.Camera(rotation, -rotation @ position, width, height, *lens)
