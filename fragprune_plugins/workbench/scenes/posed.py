"""Photographs of a scene before they are read, with their lenses; and which are held out.

OpenCV straightens photographs: cameras have lens distortion, rasterization has none.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, NamedTuple, TypeVar

import numpy as np
from numpy.typing import NDArray
from torch import Tensor

from fragprune_plugins.errors import DatasetError, log
from fragprune_plugins.workbench.scenes.pinhole import Camera

Pixels = NDArray[np.uint8]
Item = TypeVar("Item")
HOLD_OUT = 8  # views 0, 8, 16, ... of the sorted names are held out (hosts' llffhold)
_COEFFICIENTS_MAX = 1e3  # of a real lens they are below 1


@dataclass(frozen=True)
class Lens:
    """A lens by OpenCV's models, in COLMAP's pixels: 0.5 is the middle of the first one."""

    width: int  # of the photograph that the numbers belong to
    height: int
    fx: float
    fy: float
    cx: float
    cy: float
    coefficients: tuple[float, ...]  # k1, k2, p1, p2, k3, k4, k5, k6; of a fisheye k1, k2, k3, k4
    fisheye: bool = False  # whether the model is OpenCV's (and COLMAP's) fisheye

    def __post_init__(self) -> None:
        if len(self.coefficients) != (4 if self.fisheye else 8):
            raise ValueError(f"{len(self.coefficients)} coefficients of distortion")
        if not all(abs(each) < _COEFFICIENTS_MAX for each in self.coefficients):
            raise ValueError(f"the coefficients of distortion {list(self.coefficients)}")

    @property
    def straight(self) -> bool:
        """Whether the lens is a pinhole's."""
        return not self.fisheye and not any(self.coefficients)

    def camera(self, rotation: Tensor, translation: Tensor) -> Camera:
        """The pinhole camera at this pose whose photograph ``straighten`` makes.

        It has as many pixels, and sees as much as it can without a pixel that the photograph lacks.
        """
        size = self.width, self.height
        own = Camera(rotation, translation, *size, self.fx, self.fy, self.cx, self.cy)
        if self.straight:
            return own
        cv2, matrix, bend = _opencv(), _matrix(own), np.array(self.coefficients)
        if self.fisheye:
            estimate = cv2.fisheye.estimateNewCameraMatrixForUndistortRectify
            found = estimate(matrix, bend, size, np.eye(3), balance=0.0)
        else:
            found, _ = cv2.getOptimalNewCameraMatrix(matrix, bend, size, alpha=0)
        fx, fy, cx, cy = (float(found[at]) for at in ((0, 0), (1, 1), (0, 2), (1, 2)))
        return Camera(rotation, translation, *size, fx, fy, cx + 0.5, cy + 0.5)

    def straighten(self, pixels: Pixels, camera: Camera) -> Pixels:
        """A photograph (H, W, channels), of any size with its aspect, as its ``camera`` sees it."""
        cv2, size = _opencv(), pixels.shape[1::-1]
        own = replace(camera, fx=self.fx, fy=self.fy, cx=self.cx, cy=self.cy)
        here, seen = (_matrix(each.resized(*size)) for each in (own, camera))
        make = cv2.fisheye.initUndistortRectifyMap if self.fisheye else cv2.initUndistortRectifyMap
        maps = make(here, np.array(self.coefficients), np.eye(3), seen, size, cv2.CV_32FC1)
        edge = cv2.BORDER_REPLICATE
        straight: Pixels = cv2.remap(pixels, *maps, cv2.INTER_LINEAR, borderMode=edge)
        return straight.reshape(pixels.shape)


def _matrix(camera: Camera) -> np.ndarray[Any, Any]:
    """Intrinsics as OpenCV has them, where 0 is the middle of the first pixel."""
    x, y = camera.cx - 0.5, camera.cy - 0.5
    return np.array([[camera.fx, 0.0, x], [0.0, camera.fy, y], [0.0, 0.0, 1.0]])


def _opencv() -> Any:
    try:
        import cv2
    except ImportError as error:
        found = "lens distortion, and OpenCV is not installed"
        expected = "undistorted images, or OpenCV to undistort them"
        first = "or undistort them first (colmap image_undistorter)."
        remedy = f"pip install 'fragprune-plugins[undistort]', {first}"
        raise DatasetError("lens", found, expected, remedy) from error
    return cv2


class Posed(NamedTuple):
    """A photograph that a scene lists, before any of its pixels is read."""

    name: str  # unique in the scene
    camera: Camera  # of the straightened photograph
    image: Path
    lens: Lens | None = None  # what straightens it; None if it is straight
    mask: Path | None = None  # of the same aspect, black where the photograph is to be ignored


def hold_out(items: Sequence[Item]) -> tuple[list[Item], list[Item]]:
    """The items to learn from, and every 8th for measuring, from the first on."""
    return [item for index, item in enumerate(items) if index % HOLD_OUT], [*items[::HOLD_OUT]]


def split(rows: list[Posed]) -> tuple[list[Posed], list[Posed]]:
    """The training views and the held-out views of a scene that does not say which they are.

    Hosts sort by names without their suffix and folder, which they end at the first dot; 3DGS since
    October 2024 by whole names. It is warned of where that holds out other views.
    """
    train, test = hold_out(sorted(rows, key=lambda row: Path(row.name).stem))
    whole = sorted(row.name for row in rows)[::HOLD_OUT]
    if set(whole) != {row.name for row in test}:
        log.warning(
            "3DGS since October 2024 holds out other views of this scene: it sorts whole names. "
            "For a model of it, rename the images so that both orders agree, and train again; "
            "until then figures on held-out views include views that it was trained on"
        )
    _, dotted = hold_out(sorted(rows, key=lambda row: Path(row.name).name.partition(".")[0]))
    if {row.name for row in dotted} != {row.name for row in test}:
        log.warning(
            "3DGS before October 2024 and most hosts hold out other views of this scene: to them a "
            "name ends at its first dot. For a model of them, name the images without other dots, "
            "and train again; until then figures on held-out views include views that it was "
            "trained on"
        )
    return train, test
