"""Reads COLMAP's text files."""

from pathlib import Path

import numpy as np
from PIL import Image
from utils.camera_utils import size_read
from utils.graphics_utils import BasicPointCloud, focal2fov

from scene.cameras import Camera


def read_cameras(args):
    """Read every photograph with its camera, sorted by name."""
    sparse = Path(args.source_path) / "sparse" / "0"
    lenses = {}
    for fields in map(str.split, _lines(sparse / "cameras.txt")):
        if fields[1] not in ("PINHOLE", "SIMPLE_PINHOLE"):
            raise ValueError(f"camera model {fields[1]}: only undistorted photographs can be used")
        width, height, fx = (float(x) for x in fields[2:5])
        fy = float(fields[5]) if fields[1] == "PINHOLE" else fx
        lenses[fields[0]] = focal2fov(fx, width), focal2fov(fy, height)
    cameras = []
    # Every other line lists the image's 2D points, and may be empty.
    poses = [line.split() for line in _lines(sparse / "images.txt", keep_empty=True)[::2]]
    for uid, fields in enumerate(sorted(poses, key=lambda pose: pose[9])):
        numbers = np.array([float(x) for x in fields[1:8]])
        with Image.open(Path(args.source_path) / args.images / fields[9]) as picture:
            image = np.array(picture.convert("RGB").resize(size_read(picture, args)))
        cameras.append(
            Camera(
                uid,
                _rotation(numbers[:4]),
                numbers[4:],
                *lenses[fields[8]],
                image,
                Path(fields[9]).stem,
                args.data_device,
            )
        )
    return cameras


def read_points(args):
    """Read the points of the sparse reconstruction."""
    lines = _lines(Path(args.source_path) / "sparse" / "0" / "points3D.txt")
    table = np.array([[float(x) for x in line.split()[1:7]] for line in lines])
    return BasicPointCloud(table[:, :3], table[:, 3:] / 255, np.zeros_like(table[:, :3]))


def _lines(path, keep_empty=False):
    lines = [line for line in path.read_text().splitlines() if not line.startswith("#")]
    return lines if keep_empty else [line for line in lines if line.strip()]


def _rotation(quaternion):
    w, x, y, z = quaternion / np.linalg.norm(quaternion)
    cross = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])
    return np.eye(3) + 2 * w * cross + 2 * cross @ cross
