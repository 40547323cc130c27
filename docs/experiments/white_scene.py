"""Makes the scene `white`: pictures of a splat before white, in Blender's layout.

python white_scene.py SPLAT.ply CAMERA_PATH.json OUT

The cameras are those of the path (c2w, OpenCV axes), and 32 on a ring above it. Each picture has
3x3 samples a pixel. Every eighth of them, shuffled, is held out. A training begins with 5,000 of
the splat's means, moved a little: `train.py -s OUT -w`.
"""

from __future__ import annotations

import json
import math
import sys
from pathlib import Path

import numpy as np
import PIL.Image
import torch
from plyfile import PlyData, PlyElement

from fragprune_plugins.engines import create_engine
from fragprune_plugins.files.model import Model
from fragprune_plugins.files.ply import read_ply
from fragprune_plugins.types import RasterInputs
from fragprune_plugins.workbench.models.formats.arrays import SH_C0
from fragprune_plugins.workbench.scenes.pinhole import Camera

SIDE = 256
SAMPLES = 3  # along each side of a pixel
RING = 32
POINTS = 5000


def ring(poses: list[np.ndarray]) -> list[np.ndarray]:
    """Poses 15 to 45 degrees above a path around the y axis, y down, that look at its middle."""
    centre = np.mean([pose[:3, 3] for pose in poses], axis=0) * [1, 0, 1]
    radius = float(np.linalg.norm(poses[0][:3, 3] - centre))
    found = []
    for i in range(RING):
        turn = 2 * math.pi * (i + 0.5) / RING
        up = math.radians(30 + 15 * math.sin(3 * turn))
        away = [math.cos(turn) * math.cos(up), -math.sin(up), math.sin(turn) * math.cos(up)]
        pose = np.eye(4)
        pose[:3, 3] = centre + radius * np.array(away)
        z = (centre - pose[:3, 3]) / np.linalg.norm(centre - pose[:3, 3])
        x = np.cross(z, [0, -1, 0])
        x /= np.linalg.norm(x)
        pose[:3, 0], pose[:3, 1], pose[:3, 2] = x, np.cross(z, x), z
        found.append(pose)
    return found


def picture(model: Model, pose: np.ndarray, tangent: float) -> PIL.Image.Image:
    """What a camera sees, 8 bits, before white."""
    to_camera, size = torch.from_numpy(np.linalg.inv(pose)), SIDE * SAMPLES
    lens = (size / (2 * tangent), size / (2 * tangent), size / 2, size / 2)
    camera = Camera(to_camera[:3, :3], to_camera[:3, 3], size, size, *lens)
    engine, drawn = create_engine("cpu"), []
    for ground in (0.0, 1.0):
        seen = camera.view(torch.full((3,), ground))
        with torch.no_grad():
            image = engine.rasterize(RasterInputs(seen, model.splats(), planes=()), None).image
        pixels = image.reshape(3, SIDE, SAMPLES, SIDE, SAMPLES).mean((2, 4))
        drawn.append(pixels.permute(1, 2, 0).numpy())
    alpha = np.clip(1 - (drawn[1] - drawn[0]).mean(-1, keepdims=True), 0, 1)
    colour = np.clip(drawn[0] / np.maximum(alpha, 1e-6), 0, 1)
    cut = PIL.Image.fromarray((255 * np.concatenate([colour, alpha], -1) + 0.5).astype(np.uint8))
    white = PIL.Image.new("RGB", cut.size, "white")
    white.paste(cut, (0, 0), cut)
    return white


def points(model: Model, path: Path) -> None:
    """Where a training begins."""
    rng = np.random.default_rng(0)
    chosen = rng.choice(len(model), POINTS, replace=False)
    rows = np.zeros(POINTS, [(k, "f4") for k in ("x", "y", "z", "nx", "ny", "nz")] + [
        (k, "u1") for k in ("red", "green", "blue")
    ])  # fmt: skip
    for k, name in enumerate("xyz"):
        rows[name] = model.xyz.numpy()[chosen, k] + rng.normal(0, 0.02, POINTS)
    for k, name in enumerate(("red", "green", "blue")):
        colour = 0.5 + SH_C0 * model.f_dc.numpy()[chosen, 0, k]
        rows[name] = np.clip(255 * colour, 0, 255)
    PlyData([PlyElement.describe(rows, "vertex")]).write(path)


def main() -> None:
    """Draw, split and write."""
    splat, cameras, out = map(Path, sys.argv[1:])
    model, path = read_ply(splat), json.loads(cameras.read_text())
    tangent = path["width"] / (2 * path["fx"])
    poses = [np.array(frame["c2w"]) for frame in path["frames"]]
    poses += ring(poses)
    order = np.random.default_rng(0).permutation(len(poses))
    rows: dict[str, list[dict[str, object]]] = {"train": [], "test": []}
    for k, i in enumerate(order):
        kind = "train" if k % 8 else "test"
        name = f"{kind}/v_{i:03d}"
        (out / kind).mkdir(parents=True, exist_ok=True)
        picture(model, poses[i], tangent).save(out / f"{name}.png")
        blender = poses[i] * [1, -1, -1, 1]
        rows[kind].append({"file_path": name, "transform_matrix": blender.tolist()})
    for kind, frames in rows.items():
        found = {"camera_angle_x": 2 * math.atan(tangent), "frames": frames}
        (out / f"transforms_{kind}.json").write_text(json.dumps(found))
    points(model, out / "points3d.ply")


if __name__ == "__main__":
    main()
