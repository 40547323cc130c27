"""Sizes of image files, without decoding them."""

from __future__ import annotations

from pathlib import Path

from fragprune_plugins.errors import DatasetError


def image_size(path: Path) -> tuple[int, int]:
    """Width and height of an image file, pixels.

    Raises:
        DatasetError: the file is missing or not an image.
    """
    from PIL import Image

    try:
        with Image.open(path) as file:
            return file.size
    except FileNotFoundError as error:
        raise DatasetError(
            str(path), "no such image", "the image its camera names", "Add it, or remove the view."
        ) from error
    except (OSError, SyntaxError) as error:
        raise unreadable(path, error) from error


def unreadable(path: Path, error: Exception) -> DatasetError:
    """The error for an image file that Pillow cannot read."""
    return DatasetError(
        str(path), f"not readable ({error})", "a PNG or JPEG image", "Save the image again."
    )
