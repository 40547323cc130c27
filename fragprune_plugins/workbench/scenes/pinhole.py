"""A pinhole camera with its pose, which every reader returns."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any, Final

import torch
from torch import Tensor

from fragprune_plugins.errors import InputError
from fragprune_plugins.types import View, check_lens, check_tensor, one_line

ROTATION_TOLERANCE: Final = 1e-2  # of R R^T from 1: matrices come rounded to a few digits
DISTANCE_MAX: Final = 1e12  # world units from the origin: float32 holds its square


@dataclass(frozen=True)
class Camera:
    """A pinhole camera and its pose; construction checks that they are plausible.

    Every reader of cameras makes these, so this is where geometry is checked. Sides, focal lengths
    and the principal point, width / 2 of which is the centre, are in pixels.
    """

    rotation: Tensor  # (3, 3) float64, world to camera (x right, y down, z forward)
    translation: Tensor  # (3,) float64
    width: int
    height: int
    fx: float
    fy: float
    cx: float
    cy: float

    __repr__ = one_line

    def __post_init__(self) -> None:
        check_lens(self.width, self.height, self.fx, self.fy, self.cx, self.cy)
        check_tensor("rotation", self.rotation, 3, 3, needed=True)
        check_tensor("translation", self.translation, 3, needed=True)
        exact, place = self.rotation.detach().double(), self.translation.detach()
        skew = float((exact @ exact.T - torch.eye(3).to(exact)).abs().max())
        # NaN, too, is not within the tolerance.
        if not (skew <= ROTATION_TOLERANCE and float(torch.linalg.det(exact)) > 0):
            found = f"{[[float(f'{value:.4g}') for value in row] for row in exact.tolist()]}"
            expected = "a rotation: finite, orthonormal, not mirrored"
            raise InputError("rotation", found, expected, "Check the camera.")
        if not float(place.abs().max()) <= DISTANCE_MAX:
            expected = f"finite, at most {DISTANCE_MAX:g} world units"
            raise InputError("translation", f"{place.tolist()}", expected, "Check the camera.")

    @property
    def off_centre(self) -> float:
        """How far the principal point is from the middle in x or y, pixels."""
        return max(abs(self.cx - self.width / 2), abs(self.cy - self.height / 2))

    def resized(self, width: int, height: int) -> Camera:
        """The same camera with another number of pixels."""
        x, y = width / self.width, height / self.height
        focal, centre = (self.fx * x, self.fy * y), (self.cx * x, self.cy * y)
        return Camera(self.rotation, self.translation, width, height, *focal, *centre)

    def moved(self, world: Tensor) -> Camera:
        """The same camera, where a similarity (4, 4) float64 takes the world into another."""
        turned, shift = world[:3, :3], world[:3, 3]
        scale = torch.linalg.det(turned).abs() ** (1 / 3)
        rotation = self.rotation @ turned.T / scale
        return replace(
            self, rotation=rotation, translation=scale * self.translation - rotation @ shift
        )

    def view(self, background: Tensor | None = None) -> View:
        """The camera as a view for engines, computed in float64, float32 in the result."""
        exact, pose = View.pinhole(**vars(self)), ("viewmatrix", "projmatrix", "campos")
        single = {name: getattr(exact, name).float() for name in pose}
        behind = torch.zeros(3) if background is None else background
        return replace(exact, background=behind, **single)


def focal(side: float, angle: float) -> float:
    """The focal length of a camera that sees a side of its picture under an angle, radians."""
    return side / (2 * math.tan(angle / 2))


def look_at(
    eye: Sequence[float] | Tensor,
    target: Sequence[float] | Tensor,
    up: Sequence[float] | Tensor = (0.0, -1.0, 0.0),
    *,
    width: int = 960,
    height: int = 720,
    fov_y: float = 50.0,
    background: Tensor | None = None,
) -> View:
    """A camera at a place that looks at another; on the CPU, float32.

    Args:
        eye: (3,) camera centre in the world.
        target: (3,) what is in the middle of the picture.
        up: (3,) what is up in the picture, of any length; COLMAP's worlds have y down.
        width, height: pixels.
        fov_y: vertical field of view, degrees in (0, 180).
        background: (3,) RGB; black when None.

    Raises:
        InputError: eye equals target, it looks straight up or down, or fov_y is out of range.
    """
    at, to, over = (torch.as_tensor(p, dtype=torch.float64).cpu() for p in (eye, target, up))
    for name, point in (("eye", at), ("target", to), ("up", over)):
        check_tensor(f"look_at {name}", point, 3)
    forward = torch.nn.functional.normalize(to - at, dim=0)
    right = torch.linalg.cross(forward, over)
    straight = float(right.norm()) > 1e-6 * float(over.norm())  # False for NaN, too
    if not straight or not 0 < fov_y < 180:
        found = f"eye {at.tolist()}, target {to.tolist()}, up {over.tolist()}, fov_y {fov_y:g}"
        expected = "a target apart from the eye, up not along the way there, and fov_y in (0, 180)"
        raise InputError("look_at", found, expected, "Move one of them.")
    right = torch.nn.functional.normalize(right, dim=0)
    rotation = torch.stack([right, torch.linalg.cross(forward, right), forward])
    length = focal(height, math.radians(fov_y))
    lens: dict[str, Any] = {"width": width, "height": height, "fx": length, "fy": length}
    with torch.autocast("cpu", enabled=False):  # it would turn the camera, by its three digits
        pose = rotation.float(), (-rotation @ at).float()
        return View.pinhole(*pose, background=background, **lens)
