"""A facade in 25 photographs or a courtyard in 30, for trainings at full size.

python facade.py CHECKOUT SCENE [castle-P30]    (needs pycolmap)

CHECKOUT is a clone of openMVG/SfM_quality_evaluation, which holds Herz-Jesus-P25, the facade, and
castle-P30, the courtyard, of C. Strecha et al., "On Benchmarking Camera Calibration and Multi-View
Stereo for High Resolution Imagery" (CVPR 2008), with measured cameras. The photographs are reduced
to a quarter or a sixth, with the principal point in the middle; points are SIFT features
triangulated between the measured cameras at twice that size.
"""

from __future__ import annotations

import sys
import tempfile
from pathlib import Path

import numpy as np
import pycolmap
from PIL import Image

RECORDINGS = {"Herz-Jesus-P25": ((760, 502), 4), "castle-P30": ((506, 334), 6)}
"""Width and height of a photograph, reduced, and how many times smaller it is, by recording."""

Size = tuple[int, int]


def main(checkout: Path, scene: Path, recording: str = "Herz-Jesus-P25") -> None:
    """Write the scene as COLMAP does."""
    (scene / "sparse" / "0").mkdir(parents=True)  # refuses before it works where one is
    (width, height), smaller = RECORDINGS[recording]
    source = checkout / "Benchmarking_Camera_Calibration_2008" / recording
    with tempfile.TemporaryDirectory() as name:
        folder, poses, focal = Path(name), {}, 0.0
        for path in sorted((source / "images").glob("*.jpg")):
            focal, poses[path.stem] = reduce(
                path, source, (width, height), smaller, scene / "images", folder / "images"
            )
        database = folder / "features.db"
        options = pycolmap.ImageReaderOptions()
        options.camera_model = "PINHOLE"
        options.camera_params = f"{2 * focal},{2 * focal},{width},{height}"
        single = pycolmap.CameraMode.SINGLE
        pycolmap.extract_features(
            database, folder / "images", camera_mode=single, reader_options=options
        )
        pycolmap.match_exhaustive(database)
        with pycolmap.Database.open(database) as opened:
            ids = {each.image_id: each.name for each in opened.read_all_images()}
        write_cameras(folder / "cameras", (width, height), ids, poses, focal)
        measured = pycolmap.Reconstruction(str(folder / "cameras"))
        (folder / "points").mkdir()
        found = pycolmap.triangulate_points(
            measured, str(database), str(folder / "images"), str(folder / "points")
        )
    for camera in found.cameras.values():
        camera.width, camera.height = width, height
        camera.params = [each / 2 for each in camera.params]
    found.write(str(scene / "sparse" / "0"))
    print(found.summary())


def reduce(path: Path, source: Path, size: Size, smaller: int, *folders: Path) -> tuple[float, str]:
    """Write a photograph at its size and at twice that; focal length and pose, as COLMAP has it."""
    text = (source / "gt_dense_cameras" / f"{path.name}.camera").read_text()
    numbers = np.array(text.split(), dtype=float)
    (fx, _, cx), (_, fy, cy) = numbers[:9].reshape(3, 3)[:2]
    rotation, centre = numbers[12:21].reshape(3, 3).T, numbers[21:24]
    focal, (width, height) = fx / smaller, size
    half = smaller * width / 2, fy / focal * height / 2
    middle = cx + 0.5, cy + 0.5
    box = tuple(m + sign * h for sign in (-1, 1) for m, h in zip(middle, half, strict=True))
    for scale, folder in enumerate(folders, start=1):
        folder.mkdir(parents=True, exist_ok=True)
        picture = Image.open(path).resize(
            (scale * width, scale * height), Image.Resampling.BOX, box
        )
        picture.save(folder / f"{path.stem}.png")
    x, y, z, w = pycolmap.Rotation3d(rotation).quat
    pose = (w, x, y, z, *(-rotation @ centre))
    return focal, " ".join(map(str, pose))


def write_cameras(
    folder: Path, size: Size, ids: dict[int, str], poses: dict[str, str], focal: float
) -> None:
    """Write a model without points, for pictures of twice the size; ids are of a database."""
    folder.mkdir()
    width, height = size
    camera = f"1 PINHOLE {2 * width} {2 * height} {2 * focal} {2 * focal} {width} {height}\n"
    lines = [f"{i} {poses[Path(name).stem]} 1 {name}\n\n" for i, name in ids.items()]
    (folder / "cameras.txt").write_text(camera)
    (folder / "images.txt").write_text("".join(lines))
    (folder / "points3D.txt").write_text("")


if __name__ == "__main__":
    main(Path(sys.argv[1]), Path(sys.argv[2]), *sys.argv[3:])
