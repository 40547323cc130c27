"""A scene from a folder of photographs, for trainings: poses by COLMAP, undistorted, reduced.

python recording.py PHOTOGRAPHS WIDTH SCENE    (needs pycolmap)

COLMAP sees the photographs at twice the WIDTH (pixels), with one camera for all; SCENE gets those
that it placed.
"""

from __future__ import annotations

import sys
import tempfile
from pathlib import Path

import pycolmap
from PIL import Image, ImageOps


def main(photographs: Path, width: int, scene: Path) -> None:
    """Write the scene as COLMAP does."""
    (scene / "sparse" / "0").mkdir(parents=True)  # refuses before it works where one is
    (scene / "images").mkdir()
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        twice, database = folder / "twice", folder / "features.db"
        twice.mkdir()
        for path in sorted(photographs.iterdir()):
            upright = ImageOps.exif_transpose(Image.open(path)).convert("RGB")
            reduced(upright, 2 * width).save(twice / f"{path.stem}.png")
        single = pycolmap.CameraMode.SINGLE
        pycolmap.extract_features(database, twice, camera_mode=single)
        pycolmap.match_exhaustive(database)
        (folder / "models").mkdir()
        models = pycolmap.incremental_mapping(database, twice, folder / "models")
        (folder / "largest").mkdir()
        max(models.values(), key=lambda each: each.num_reg_images()).write(folder / "largest")
        pycolmap.undistort_images(folder / "undistorted", folder / "largest", twice)
        for path in (folder / "undistorted" / "images").iterdir():
            reduced(Image.open(path), width).save(scene / "images" / path.name)
        found = pycolmap.Reconstruction(folder / "undistorted" / "sparse")
        for camera in found.cameras.values():
            camera.rescale(width, round(camera.height * width / camera.width))
        found.write(scene / "sparse" / "0")
        print(found.summary())


def reduced(picture: Image.Image, width: int) -> Image.Image:
    """A picture of that width, or itself if it is smaller."""
    if picture.width <= width:
        return picture
    size = width, round(picture.height * width / picture.width)
    return picture.resize(size, Image.Resampling.LANCZOS)


if __name__ == "__main__":
    main(Path(sys.argv[1]), int(sys.argv[2]), Path(sys.argv[3]))
