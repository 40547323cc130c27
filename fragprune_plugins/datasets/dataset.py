"""Loads photographs with their cameras from a COLMAP or a Blender (transforms) folder."""

from __future__ import annotations

import os
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path
from typing import ClassVar, TypeVar

import numpy as np
import torch
from torch import Tensor

from fragprune_plugins.datasets import blender, colmap
from fragprune_plugins.datasets.images import image_size, opened
from fragprune_plugins.datasets.photographs import Photographs, Resolution
from fragprune_plugins.datasets.pinhole import Camera
from fragprune_plugins.errors import DatasetError
from fragprune_plugins.reprs import one_line
from fragprune_plugins.types import View

_ASPECT_TOLERANCE = 0.01
_ROWS = 256  # of a picture, composited at a time

SomeShot = TypeVar("SomeShot", bound="Shot")


@dataclass(frozen=True, eq=False)
class Shot:
    """A camera, and the picture to be seen from it.

    Attributes:
        name: unique in its dataset.
        view: the camera, with the background colour of its picture.
        target: what the picture is: "photographs", or "itself" for the model's own.
    """

    target: ClassVar[str] = "photographs"

    name: str
    view: View

    __repr__ = one_line

    @property
    def image(self) -> Tensor:
        """(3, H, W) RGB on the view's device."""
        raise NotImplementedError

    def to(self: SomeShot, device: torch.device | str) -> SomeShot:
        """The same with its view on a device; ``self`` if it is there already."""
        if self.view.background.device == torch.device(device):
            return self
        return replace(self, view=self.view.to(device))


@dataclass(frozen=True, eq=False)
class Photograph(Shot):
    """One photograph with its camera; RGB in [0, 1], composited over the view's background.

    Attributes:
        path: the image file. It is read at first use and kept in main memory at 8 bits a channel,
            because a scene's photographs may be larger than a GPU's memory.
    """

    path: Path

    __repr__ = one_line

    @property
    def image(self) -> Tensor:
        """(3, H, W) RGB in [0, 1] on the view's device."""
        return self._bytes.to(self.view.background.device).permute(2, 0, 1).float() / 255

    @cached_property
    def _bytes(self) -> Tensor:
        with opened(self.path) as file:
            picture = file.convert("RGBA") if "A" in file.getbands() else file.convert("RGB")
            size = (self.view.width, self.view.height)
            if picture.size != size:
                picture = picture.resize(size)
        values = np.asarray(picture)
        if values.shape[2] == 3:
            return torch.from_numpy(values.copy())
        behind = 255 * self.view.background.cpu().numpy()
        flat = np.empty((*values.shape[:2], 3), np.uint8)
        for begin in range(0, len(values), _ROWS):  # as floats, a large picture takes gigabytes
            rows = values[begin : begin + _ROWS]
            alpha = rows[..., 3:].astype(np.float32) / 255
            over = rows[..., :3] * alpha + behind * (1 - alpha)
            flat[begin : begin + _ROWS] = np.round(over).astype(np.uint8)
        return torch.from_numpy(flat)


@dataclass(frozen=True, eq=False)
class Dataset:
    """Training views, and held-out views for measuring."""

    train: Sequence[Shot]
    test: Sequence[Shot]

    __repr__ = one_line

    @property
    def extent(self) -> float:
        """1.1 times the largest distance of a training camera from their mean, world units.

        Hosts scale the learning rate of positions by this.
        """
        centres = torch.stack([shot.view.campos for shot in self.train])
        return 1.1 * float((centres - centres.mean(0)).norm(dim=1).max()) or 1.0

    def to(self, device: torch.device | str) -> Dataset:
        """The same photographs with their views on a device."""
        return Dataset([s.to(device) for s in self.train], [s.to(device) for s in self.test])


def load_photographs(photographs: Photographs) -> Dataset:
    """Load the photographs of a run with ``load_dataset``."""
    return load_dataset(
        photographs.folder,
        resolution=photographs.resolution,
        white_background=photographs.white_background,
        images=photographs.images,
    )


def load_dataset(
    folder: Path,
    *,
    resolution: int | Resolution = 1,
    white_background: bool = False,
    images: str = "images",
) -> Dataset:
    """Read a COLMAP folder (sparse/, images/) or a Blender one (transforms_train/test.json).

    COLMAP holds out every 8th view of the sorted names, as hosts do. Images whose size differs
    from their camera's are accepted when the aspect agrees to 1 %: intrinsics scale with them.

    Args:
        folder: the scene.
        resolution: a divisor of the images' sides, or a ``Resolution``.
        white_background: composite images with alpha over white instead of black, and render so.
        images: name of the image folder of a COLMAP scene.

    Raises:
        DatasetError: the folder has neither layout or both, an image is missing, a camera model is
            unknown, or sizes do not match.
    """
    background = torch.full((3,), float(white_background))
    size = resolution if isinstance(resolution, Resolution) else Resolution(divide=resolution)
    train, test = (
        [make_shot(name, camera, path, background, size) for name, camera, path in part]
        for part in read_scene(folder, images)
    )
    return Dataset(train, test)


def read_scene(folder: Path, images: str = "images") -> tuple[list[colmap.Row], list[colmap.Row]]:
    """Read the training and the held-out cameras of a scene, and where their images should be.

    No image is opened, but for the size of one whose transforms file has no ``w`` and ``h``.

    Args:
        folder: the scene.
        images: name of the image folder of a COLMAP scene.

    Raises:
        DatasetError: the folder has neither layout or both, a file is broken, a camera model is
            unknown, or there are no training or no held-out cameras.
    """
    folder = Path(folder)
    if not os.path.isdir(folder):  # False for a name that no folder can have, too
        raise DatasetError(
            str(folder), "no such folder", "a folder with photographs", "Check --data."
        )
    is_colmap = colmap.find_model(folder) is not None
    is_blender = os.path.exists(folder / "transforms_train.json")
    layouts = "sparse/0 with images/ (COLMAP), or transforms_train.json (Blender)"
    if is_colmap == is_blender:
        found = "both a COLMAP and a Blender layout" if is_colmap else "neither layout"
        remedy = (
            "Move one of the two aside." if is_colmap else "Pass the folder that contains them."
        )
        raise DatasetError(str(folder), found, layouts, remedy)
    train, test = colmap.read(folder, images) if is_colmap else blender.read(folder)
    for name, part in (("training", train), ("held-out", test)):
        if not part:
            raise DatasetError(
                str(folder),
                f"no {name} view ({len(train) + len(test)} in all)",
                "at least one training and one held-out view",
                "Add photographs; every 8th is held out.",
            )
    return train, test


def make_shot(
    name: str, camera: Camera, path: Path, background: Tensor, resolution: Resolution
) -> Photograph:
    """Pair an image file with its camera. This reads only the file's header.

    Raises:
        DatasetError: the file is missing or unreadable, or its size does not fit the camera.
    """
    width, height = image_size(path)
    if abs(width * camera.height / (height * camera.width) - 1) > _ASPECT_TOLERANCE:
        raise DatasetError(
            str(path),
            f"{width}x{height} pixels",
            f"those of its camera, {camera.width}x{camera.height}, or that aspect",
            "Use the images that the cameras were calibrated with.",
        )
    return Photograph(name, camera.resized(*resolution.of(width, height)).view(background), path)
