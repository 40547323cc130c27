"""Opens image files: PNG, JPEG, WebP, TIFF and BMP, of bounded size."""

from __future__ import annotations

import contextlib
import os
import warnings
from collections.abc import Iterator
from pathlib import Path

from PIL import Image, UnidentifiedImageError

from fragprune_plugins.constants import SIDE_MAX
from fragprune_plugins.errors import DatasetError
from fragprune_plugins.files.reading import UntrustedFile

PIXELS_MAX = 160_000_000  # cameras reach 151 million; Pillow itself refuses 179 million
_FORMATS = ("PNG", "JPEG", "WEBP", "TIFF", "BMP")  # some of Pillow's other readers run programs
_ORIENTATION = 0x0112  # of EXIF
_CUT = ("I", "F")  # modes beside 16-bit grey whose values Pillow cuts at 255: bright is white

IMAGE_FILE = UntrustedFile(
    DatasetError,
    "not readable",
    "a PNG or JPEG image",
    "Save the image again.",
    missing="Add it, or remove the view.",
    noun="image",
)

SUFFIXES = (".png", ".jpg", ".jpeg", ".webp", ".tif", ".tiff", ".bmp")


def find_image(path: Path) -> Path:
    """The image file that a scene lists: the path, or one of its folder and stem.

    Scenes list images without a suffix (Blender's), or with that of before they were made smaller
    or renamed, or in another case. If there is no file, or more than one, it is the path.
    """
    if path.is_file():
        return path
    stem = path.stem if path.suffix.lower() in SUFFIXES else path.name
    folded = stem.casefold()
    try:
        names = [name for name in os.listdir(path.parent) if name.casefold().startswith(folded)]
    except OSError:
        return path
    images = [each for each in map(path.with_name, names) if each.suffix.lower() in SUFFIXES]
    found = [each for each in images if each.stem == stem]
    found = found or [each for each in images if each.stem.casefold() == folded]
    return found[0] if len(found) == 1 else path


@contextlib.contextmanager
def opened(path: Path) -> Iterator[Image.Image]:
    """Open an image for the length of a block; its pixels are read on use.

    A file that is missing, no image or too large is a DatasetError, and what the block raises.
    """
    with IMAGE_FILE.reading(path) as reading, warnings.catch_warnings():
        warnings.simplefilter("ignore", Image.DecompressionBombWarning)  # PIXELS_MAX decides
        warnings.filterwarnings("ignore", "Corrupt EXIF")  # pixels are read without
        try:
            image = Image.open(reading.file, formats=_FORMATS)
        except UnidentifiedImageError as error:
            kinds = f"no {', '.join(_FORMATS)}" if reading.size else "it is empty"
            raise ValueError(kinds) from error
        with image:
            width, height = image.size
            if width * height > PIXELS_MAX or max(width, height) > SIDE_MAX:
                expected = f"at most {PIXELS_MAX:,} pixels, and {SIDE_MAX:,} a side"
                found = f"{width}x{height} pixels"
                raise DatasetError(str(path), found, expected, "Make the image smaller.")
            if image.mode in _CUT or image.mode.startswith("I;16"):
                found = f"pixels of mode {image.mode}, which would all be cut to 8 bits"
                remedy = "Save the image with 8 bits a channel."
                raise DatasetError(str(path), found, "8 bits a channel", remedy)
            yield image


def image_size(path: Path) -> tuple[int, int]:
    """Width and height of an image file, pixels. Only its header is read."""
    with opened(path) as image:
        return image.size


def turned(path: Path) -> bool | None:
    """Whether EXIF turns an image without another aspect, which would show in its camera.

    None if it is broken, so that it does not tell.
    """
    with contextlib.suppress(DatasetError), opened(path) as image:
        if "exif" in image.info:  # elsewhere Pillow decodes the image to look for it
            exif = Image.Exif()
            try:
                warnings.simplefilter("error")
                exif.load(image.info["exif"])
            except (Warning, SyntaxError):
                return None
            turn = exif.get(_ORIENTATION, 1)
            return turn in (2, 3, 4) or (turn in (5, 6, 7, 8) and image.width == image.height)
    return False
