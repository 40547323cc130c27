"""Makes posed photographs of the demo's room, as a COLMAP data set in text form."""

from __future__ import annotations

import math
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from PIL import Image
from scipy.spatial.transform import Rotation

from fragprune_plugins.files.atomic import replacing
from fragprune_plugins.workbench.models.model import writable_folder
from lab.room.furniture import CENTRE, furnish
from lab.room.textures import displayed
from lab.room.tracer import FAR, Array, World, times


@dataclass(frozen=True)
class Photo:
    """The camera of one photograph.

    Attributes:
        name: name of the image file.
        width: width in pixels.
        height: height in pixels.
        focal: focal length in pixels, in x and y; the principal point is the image's centre.
        rotation: (3, 3) world to camera; x right, y down, z forward.
        translation: (3,) world to camera.
    """

    name: str
    width: int
    height: int
    focal: float
    rotation: NDArray[np.float64]
    translation: NDArray[np.float64]

    @property
    def centre(self) -> NDArray[np.float64]:
        """(3,) position of the camera in the world."""
        centre: NDArray[np.float64] = -self.rotation.T @ self.translation
        return centre

    def project(self, points: NDArray[np.float64]) -> tuple[NDArray[np.float64], ...]:
        """Pixel coordinates (n, 2) and depths (n,) of points (n, 3); pixel centres end in .5."""
        local = points @ self.rotation.T + self.translation
        flat = local[:, :2] / local[:, 2:] * self.focal
        return flat + np.array([self.width / 2, self.height / 2]), local[:, 2]

    def rays(self, pixels: NDArray[np.float64]) -> Array:
        """Unit directions (3, n) through pixel coordinates (n, 2)."""
        offset = (pixels - np.array([self.width / 2, self.height / 2])) / self.focal
        local = np.concatenate([offset, np.ones((len(pixels), 1))], axis=1)
        local /= np.linalg.norm(local, axis=1, keepdims=True)
        return times(self.rotation.T.astype(np.float32), local.T.astype(np.float32))


@dataclass(frozen=True)
class SceneSettings:
    """Settings of a scene.

    Attributes:
        views: number of photographs.
        width: width in pixels.
        height: height in pixels.
        supersample: square root of the number of rays per pixel.
        points: number of surface points, which stand for COLMAP's triangulated points.
        seed: seed of textures, cameras and points.
    """

    views: int = 48
    width: int = 320
    height: int = 240
    supersample: int = 3
    points: int = 4000
    seed: int = 0


def photos(settings: SceneSettings) -> list[Photo]:
    """Cameras on a quarter of a sphere around the still life.

    The positions are an additive low-discrepancy sequence. Every eighth position, a held-out view,
    is such a sequence too, so held-out views cover the same arc.
    """
    rng = np.random.default_rng([settings.seed, 1])
    focal = settings.width / 2 / math.tan(math.radians(29))
    cameras = []
    for index in range(settings.views):
        azimuth = math.radians(2 + 86 * ((0.5 + index * math.sqrt(2)) % 1))
        elevation = math.radians(9 + 40 * ((0.5 + index * math.sqrt(3)) % 1))
        radius = 3.4 + rng.uniform(-0.3, 0.3)
        target = np.array(CENTRE) + rng.uniform(-0.12, 0.12, 3)
        back = np.array(
            [
                math.cos(elevation) * math.cos(azimuth),
                math.cos(elevation) * math.sin(azimuth),
                math.sin(elevation),
            ]
        )
        right = np.array([-math.sin(azimuth), math.cos(azimuth), 0.0])
        rotation = np.stack([right, np.cross(right, back), -back])
        cameras.append(
            Photo(
                name=f"view_{index:03d}.webp",
                width=settings.width,
                height=settings.height,
                focal=focal,
                rotation=rotation,
                translation=-rotation @ (target + radius * back),
            )
        )
    return cameras


def photograph(world: World, photo: Photo, supersample: int) -> NDArray[np.uint8]:
    """The picture (height, width, 3), with a box filter over supersample^2 rays per pixel."""
    n = supersample
    x = (np.arange(photo.width * n) + 0.5) / n
    y = (np.arange(photo.height * n) + 0.5) / n
    pixels = np.stack(np.meshgrid(x, y), axis=-1).reshape(-1, 2)
    origin = photo.centre.astype(np.float32)[:, None]
    light = world.colour(origin, photo.rays(pixels)).T.reshape(photo.height, n, photo.width, n, 3)
    shown = displayed(light.mean(axis=(1, 3), dtype=np.float32))
    return (shown * 255 + 0.5).astype(np.uint8)


def surface_points(
    world: World, cameras: list[Photo], count: int, seed: int
) -> tuple[NDArray[np.float64], NDArray[np.uint8]]:
    """Points (n, 3) that the cameras see, spread evenly over pixels, and their colours (n, 3)."""
    rng = np.random.default_rng([seed, 2])
    positions, colours = [], []
    for index, photo in enumerate(cameras):
        share = count // len(cameras) + (index < count % len(cameras))
        pixels = rng.uniform(0, 1, (share, 2)) * (photo.width, photo.height)
        direction = photo.rays(pixels)
        origin = photo.centre.astype(np.float32)[:, None]
        distance, _ = world.hit(origin, direction)
        seen = distance < FAR
        positions.append((origin + direction * distance)[:, seen].T)
        colours.append(displayed(world.colour(origin, direction[:, seen])).T)
    points = np.concatenate(positions).astype(np.float64)
    return points, (np.concatenate(colours) * 255 + 0.5).astype(np.uint8)


def make_scene(folder: Path, settings: SceneSettings | None = None) -> None:
    """Write ``images/`` and ``sparse/0/`` in COLMAP's text form.

    Args:
        folder: folder of the scene; made if it is missing.
        settings: the scene's settings; None for the defaults.

    Raises:
        OutputError: the folder cannot be written.
    """
    settings = settings or SceneSettings()
    images, sparse = writable_folder(folder / "images"), writable_folder(folder / "sparse" / "0")
    world, cameras = furnish(settings.seed), photos(settings)
    with ThreadPoolExecutor(2) as pool:
        pictures = pool.map(lambda p: photograph(world, p, settings.supersample), cameras)
        for photo, picture in zip(cameras, pictures, strict=True):
            with replacing(images / photo.name) as path:
                Image.fromarray(picture).save(path, quality=72, method=6)
    points, colours = surface_points(world, cameras, settings.points, settings.seed)
    _write(sparse / "cameras.txt", _cameras_text(cameras[0]))
    _write(sparse / "images.txt", _images_text(cameras))
    _write(sparse / "points3D.txt", _points_text(points, colours))


def _write(path: Path, text: str) -> None:
    with replacing(path) as temporary:
        temporary.write_text(text, encoding="utf-8")


def _cameras_text(photo: Photo) -> str:
    x, y = photo.width / 2, photo.height / 2
    size = f"{photo.width} {photo.height}"
    return (
        "# CAMERA_ID MODEL WIDTH HEIGHT FX FY CX CY\n"
        f"1 PINHOLE {size} {photo.focal!r} {photo.focal!r} {x!r} {y!r}\n"
    )


def _images_text(cameras: list[Photo]) -> str:
    """Two lines for each image; the second line, for 2D points, is empty."""
    lines = ["# IMAGE_ID QW QX QY QZ TX TY TZ CAMERA_ID NAME", "# POINTS2D[] (none)"]
    for number, photo in enumerate(cameras, start=1):
        numbers = [*quaternion(photo.rotation), *photo.translation]
        pose = " ".join(repr(float(x)) for x in numbers)
        lines += [f"{number} {pose} 1 {photo.name}", ""]
    return "\n".join(lines) + "\n"


def _points_text(points: NDArray[np.float64], colours: NDArray[np.uint8]) -> str:
    lines = ["# POINT3D_ID X Y Z R G B ERROR TRACK[]"]
    for number, (point, colour) in enumerate(zip(points, colours, strict=True), start=1):
        x, y, z = (f"{c:.3f}" for c in point)
        r, g, b = (int(c) for c in colour)
        lines.append(f"{number} {x} {y} {z} {r} {g} {b} 0")
    return "\n".join(lines) + "\n"


def quaternion(rotation: NDArray[np.float64]) -> NDArray[np.float64]:
    """Quaternion (4,) w, x, y, z of a rotation matrix (3, 3), with w >= 0."""
    x, y, z, w = Rotation.from_matrix(rotation).as_quat(canonical=True)
    return np.array([w, x, y, z])
