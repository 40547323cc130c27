"""A pinhole camera with its pose, which every reader returns."""

from __future__ import annotations

from dataclasses import dataclass, replace

import torch
from torch import Tensor

from fragprune_plugins.constants import DISTANCE_MAX, ROTATION_TOLERANCE
from fragprune_plugins.errors import InputError
from fragprune_plugins.types import View, check_lens, one_line, require_tensor


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
        return replace(
            self,
            width=width,
            height=height,
            fx=self.fx * x,
            fy=self.fy * y,
            cx=self.cx * x,
            cy=self.cy * y,
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
        return replace(
            exact,
            viewmatrix=exact.viewmatrix.float(),
            projmatrix=exact.projmatrix.float(),
            campos=exact.campos.float(),
            background=torch.zeros(3) if background is None else background,
        )


def check_pose(rotation: Tensor, translation: Tensor) -> None:
    """Check that tensors are a camera's pose: see ``Camera``. Waits for a GPU.

    Raises:
        InputError: not a rotation matrix, or the camera is not within ``DISTANCE_MAX``.
    """
    require_tensor("rotation", rotation, 3, 3)
    require_tensor("translation", translation, 3)
    exact = rotation.detach().double()
    skew = float((exact @ exact.T - torch.eye(3).to(exact)).abs().max())
    # NaN, too, is not within the tolerance.
    if not (skew <= ROTATION_TOLERANCE and float(torch.linalg.det(exact)) > 0):
        found = f"{[[float(f'{value:.4g}') for value in row] for row in exact.tolist()]}"
        expected = "a rotation: finite, orthonormal, not mirrored"
        raise InputError("rotation", found, expected, "Check the camera.")
    if not float(translation.detach().abs().max()) <= DISTANCE_MAX:
        expected = f"finite, at most {DISTANCE_MAX:g} world units"
        raise InputError("translation", f"{translation.tolist()}", expected, "Check the camera.")
