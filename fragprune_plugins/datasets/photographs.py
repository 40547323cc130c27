"""Which photographs a model was trained on, and how they were read: enough to read them again."""

from __future__ import annotations

from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any


@dataclass(frozen=True)
class Resolution:
    """At how many pixels photographs are read.

    Attributes:
        divide: both sides are divided by this and rounded.
        width: pixels; where given, images are scaled to this width in place of being divided, and
            both sides cut down to whole pixels.
        shrink_only: images narrower than ``width`` stay as they are.
    """

    divide: int = 1
    width: int | None = None
    shrink_only: bool = False

    def of(self, width: int, height: int) -> tuple[int, int]:
        """The size that an image of this size is read at, one pixel or more a side.

        The arithmetic is the hosts', rounding and all: a pixel more is another picture.
        """
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
        folder: COLMAP's or Blender's.
        resolution: of the images.
        white_background: images with alpha are composited over white instead of black.
        images: name of the folder of a COLMAP scene that holds the images.
    """

    folder: Path
    resolution: Resolution = Resolution()
    white_background: bool = False
    images: str = "images"

    def as_dict(self) -> dict[str, Any]:
        """Plain values, for records."""
        return asdict(self) | {"folder": str(self.folder.resolve())}

    @classmethod
    def from_dict(cls, values: dict[str, Any]) -> Photographs:
        """What ``as_dict`` gave; records of earlier versions have a divisor as resolution."""
        size = values["resolution"]
        return cls(
            Path(values["folder"]),
            Resolution(**size) if isinstance(size, dict) else Resolution(divide=size),
            values["white_background"],
            values.get("images", "images"),
        )
