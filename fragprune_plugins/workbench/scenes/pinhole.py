"""A pinhole camera with its pose, which every reader returns."""

from __future__ import annotations

import logging
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, NamedTuple

import torch
from torch import Tensor

from fragprune_plugins.reprs import one_line
from fragprune_plugins.types import View, check_lens, check_pose

if TYPE_CHECKING:
    from fragprune_plugins.workbench.scenes.lenses import Lens


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


log = logging.getLogger(__name__)

HOLD_OUT = 8
"""Views 0, 8, 16, ... of the sorted names are held out (hosts' llffhold)."""


class Posed(NamedTuple):
    """A photograph that a scene lists, before any of its pixels is read.

    Attributes:
        name: unique in the scene.
        camera: of the straightened photograph.
        image: the file.
        lens: what straightens it; None if it is straight.
        mask: a picture of the same aspect, black where the photograph is to be ignored.
    """

    name: str
    camera: Camera
    image: Path
    lens: Lens | None = None
    mask: Path | None = None


def split(rows: list[Posed]) -> tuple[list[Posed], list[Posed]]:
    """The training views and the held-out views of a scene that does not say which they are.

    Hosts sort by names without their suffix and folder, 3DGS since October 2024 by whole names. It
    is warned of where that holds out other views.
    """
    ordered = sorted(rows, key=lambda row: Path(row.name).stem)
    train, test = [row for i, row in enumerate(ordered) if i % HOLD_OUT], ordered[::HOLD_OUT]
    whole = sorted(row.name for row in rows)[::HOLD_OUT]
    if set(whole) != {row.name for row in test}:
        log.warning(
            "3DGS since October 2024 holds out other views of this scene: it sorts whole names. "
            "For a model of it, rename the images so that both orders agree, and train again; "
            "until then figures on held-out views include views that it was trained on"
        )
    return train, test
