"""Records which photographs a model was trained on and how they were read, to read them again."""

from __future__ import annotations

from collections.abc import Collection
from dataclasses import dataclass
from pathlib import Path

from fragprune_plugins.constants import SIDE_MAX
from fragprune_plugins.errors import InputError

Similarity = tuple[tuple[float, ...], ...]  # four rows of four

WIDEST = 1600  # pixels; hosts shrink wider images to this width where no size is asked for (-r -1)


@dataclass(frozen=True)
class Resolution:
    """The size at which photographs are read.

    Attributes:
        divide: both sides are divided by this and rounded.
        width: pixels. If given, images are scaled to it instead, to sides cut down to whole pixels.
        shrink_only: images narrower than ``width`` stay as they are.
    """

    divide: int = 1
    width: int | None = None
    shrink_only: bool = False

    def __post_init__(self) -> None:
        for name, value, most in (("divide", self.divide, 1024), ("width", self.width, SIDE_MAX)):
            number = isinstance(value, int | float) and 1 <= value <= most
            if not number and not (name == "width" and value is None):
                remedy = "Check the resolution."
                raise InputError(f"Resolution.{name}", repr(value)[:80], f"1 to {most}", remedy)

    @classmethod
    def asked(cls, value: int, divisors: Collection[int]) -> Resolution:
        """The size for a host's ``-r``: a divisor, a width, or -1: at most ``WIDEST`` wide."""
        if value in divisors:
            return cls(divide=value)
        return cls(width=WIDEST if value < 1 else value, shrink_only=value < 1)

    def of(self, width: int, height: int) -> tuple[int, int]:
        """The size at which hosts read an image of this size, to the pixel; at least one a side."""
        if self.width is None:
            return max(1, round(width / self.divide)), max(1, round(height / self.divide))
        if self.shrink_only and width <= self.width:
            return width, height
        scale = width / self.width
        return max(1, int(width / scale)), max(1, int(height / scale))


@dataclass(frozen=True)
class Photographs:
    """A scene folder and how its images are read.

    Attributes:
        folder: a COLMAP or Blender scene.
        resolution: of the images.
        white_background: images with alpha are composited over white instead of black.
        images: name of the folder of a COLMAP scene that holds the images.
        centred: whether the principal point is a picture's middle, as in 3DGS; None if unknown.
        opaque: the host drops alpha channels, as 3DGS does of a COLMAP scene.
        held_out: the host does not train on what is held out here.
        world: takes the scene's world into that of the models; None if it is the same.
    """

    folder: Path
    resolution: Resolution = Resolution()
    white_background: bool = False
    images: str = "images"
    centred: bool | None = None
    opaque: bool = False
    held_out: bool = True
    world: Similarity | None = None
