"""The demo's photographs of a small room, with their cameras and points, as COLMAP writes them."""

from __future__ import annotations

import shutil
from pathlib import Path

from PIL import Image

from fragprune_plugins.files.atomic import replacing
from fragprune_plugins.workbench.models.model import writable_folder

ROOM = Path(__file__).with_name("room")  # ``images/``, ``sparse/0/``; by ``python -m lab.room``
VIEWS, WIDTH, POINTS = 48, 320, 4000  # of photographs, their number and width in pixels; points


def make_scene(
    folder: Path, *, views: int = VIEWS, width: int = WIDTH, points: int = POINTS
) -> None:
    """Copy the photographs, their cameras and points to ``images/`` and ``sparse/0/`` of a folder.

    There are up to 48 and 4000, at most 320 pixels wide and three quarters of that high.
    """
    images, sparse = writable_folder(folder / "images"), writable_folder(folder / "sparse" / "0")
    for photograph in sorted((ROOM / "images").iterdir())[:views]:
        with replacing(images / photograph.name) as path:
            if width == WIDTH:
                shutil.copyfile(photograph, path)
                continue
            with Image.open(photograph) as picture:
                size = width, picture.height * width // WIDTH
                picture.resize(size, Image.Resampling.LANCZOS).save(path, "WEBP", lossless=True)
    number, model, *numbers = _lines("cameras")[0].split()
    lens = [f"{float(each) * width / WIDTH:.10g}" for each in numbers]
    kept = {
        "cameras": [" ".join([number, model, *lens])],
        "images": _lines("images")[: 2 * views],
        "points3D": _lines("points3D")[:: max(1, POINTS // points)][:points],
    }
    for name, lines in kept.items():
        with replacing(sparse / f"{name}.txt") as path:
            path.write_text("\n".join(lines) + "\n", encoding="utf-8")


def _lines(name: str) -> list[str]:
    """A file of COLMAP's text form without comments; after an image comes a line of 2D points."""
    text = (ROOM / "sparse" / "0" / f"{name}.txt").read_text(encoding="utf-8")
    return [line for line in text.splitlines() if not line.startswith("#")]
