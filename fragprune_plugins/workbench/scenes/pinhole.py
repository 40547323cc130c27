"""A pinhole camera with its pose, which every reader returns."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from fragprune_plugins.types import View, check_lens, check_pose, one_line


@dataclass(frozen=True)
class Camera:
    """A pinhole camera and its pose; construction checks that they are plausible.

    Every reader of cameras makes these, so this is where geometry is checked.

    Attributes:
        rotation: (3, 3) float64, world to camera (x right, y down, z forward).
        translation: (3,) float64.
        width: pixels.
        height: pixels.
        fx: focal length, pixels.
        fy: focal length, pixels.
        cx: principal point, pixels; width / 2 is the centre.
        cy: principal point, pixels.
    """

    rotation: Tensor
    translation: Tensor
    width: int
    height: int
    fx: float
    fy: float
    cx: float
    cy: float

    __repr__ = one_line

    def __post_init__(self) -> None:
        check_lens(self.width, self.height, self.fx, self.fy, self.cx, self.cy)
        check_pose(self.rotation, self.translation)

    def resized(self, width: int, height: int) -> Camera:
        """The same camera with another number of pixels."""
        x, y = width / self.width, height / self.height
        return Camera(
            self.rotation,
            self.translation,
            width,
            height,
            self.fx * x,
            self.fy * y,
            self.cx * x,
            self.cy * y,
        )

    def view(self, background: Tensor | None = None) -> View:
        """The camera as a view for engines, computed in float64, float32 in the result."""
        exact = View.pinhole(
            self.rotation,
            self.translation,
            width=self.width,
            height=self.height,
            fx=self.fx,
            fy=self.fy,
            cx=self.cx,
            cy=self.cy,
        )
        return View(
            width=exact.width,
            height=exact.height,
            tan_fov_x=exact.tan_fov_x,
            tan_fov_y=exact.tan_fov_y,
            viewmatrix=exact.viewmatrix.float(),
            projmatrix=exact.projmatrix.float(),
            campos=exact.campos.float(),
            background=torch.zeros(3) if background is None else background,
        )
