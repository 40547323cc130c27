"""The bench scene: random Gaussians that load a rasterizer as a trained scene does.

The figures in docs/ were measured on this scene; the same count and seed give the same numbers:
surfaces and floaters over depths 2 to 14, log-normal anisotropic scales with one short axis,
opacities of two kinds, view-dependent colour. About 53 fragments are blended per pixel, close to
Bicycle's 49.
"""

from __future__ import annotations

import numpy as np
import torch
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from fragprune_plugins.files.model import Model
from fragprune_plugins.types import View
from fragprune_plugins.workbench.models.formats.arrays import SH_C0

SEED = 20240607
_TAN = (0.66, 0.50)  # half extents of the filled frustum at depth 1
_ROTATION = Rotation.from_euler("xyz", (12.0, -25.0, 4.0), degrees=True).as_matrix()
"""World to camera."""
_TRANSLATION = np.array([0.3, -0.2, 0.5])
_HALF_WIDTH = 0.60  # horizontal half tangent of the camera
Array = NDArray[np.float64]


def make_scene(count: int = 100_000, seed: int = SEED) -> Model:
    """Gaussians of SH degree 3, raw as in a PLY; more make a denser scene, not a finer one."""
    rng = np.random.default_rng(seed)
    camera_space = _positions(rng, count)
    world = (camera_space - _TRANSLATION) @ _ROTATION
    size = np.log(0.0105 * camera_space[:, 2].clip(1.0) ** 0.75)
    size = size + 0.62 * rng.standard_normal(count)
    wide = [size + 0.40 * rng.standard_normal(count) for _ in range(2)]
    short = size - 1.6 + 0.7 * rng.standard_normal(count)
    scaling = np.stack([*wide, short], axis=1)
    rotation = rng.standard_normal((count, 4))
    rotation /= np.linalg.norm(rotation, axis=1, keepdims=True)
    rotation *= rng.uniform(0.7, 1.4, (count, 1))  # trained files hold unnormalised quaternions
    faint = rng.random(count) < 0.45
    low, high = (a + b * rng.standard_normal(count) for a, b in ((-2.75, 0.75), (2.6, 1.2)))
    opacity = np.where(faint, low, high)
    weights = rng.standard_normal((3, 3)) * 0.9
    rgb = 0.5 + 0.33 * np.sin(world @ weights + np.array([0.0, 2.0, 4.0]))
    rgb = rgb + 0.07 * rng.standard_normal((count, 3))
    rest = np.zeros((count, 3, 15))
    for first, last, spread in ((0, 3, 0.10), (3, 8, 0.05), (8, 15, 0.03)):
        rest[:, :, first:last] = spread * rng.standard_normal((count, 3, last - first))

    def tensor(values: Array) -> torch.Tensor:
        return torch.from_numpy(np.ascontiguousarray(values, dtype=np.float32))

    return Model(
        xyz=tensor(world),
        f_dc=tensor((rgb.clip(0.02, 0.98) - 0.5)[:, None] / SH_C0),
        f_rest=tensor(rest.transpose(0, 2, 1)),
        opacity=tensor(opacity[:, None]),
        scaling=tensor(scaling),
        rotation=tensor(rotation),
    )


def make_view(width: int, height: int) -> View:
    """The one camera of the scene at a given size; black background."""
    focal = width / (2 * _HALF_WIDTH)
    pose = (torch.from_numpy(each).float() for each in (_ROTATION, _TRANSLATION))
    return View.pinhole(*pose, width=width, height=height, fx=focal, fy=focal)


def _positions(rng: np.random.Generator, count: int) -> Array:
    """(N, 3) in the camera's frame: ground, wall, five blobs and free floaters, shuffled."""
    on_ground, on_wall, on_blobs = int(0.22 * count), int(0.22 * count), int(0.26 * count)
    free = count - on_ground - on_wall - on_blobs
    tan_x, tan_y = _TAN

    z = 2.0 + 12.0 * rng.beta(1.6, 2.0, on_ground)
    x = rng.uniform(-1.1, 1.1, on_ground) * tan_x * z
    ground = np.stack([x, 1.1 + 0.03 * rng.standard_normal(on_ground), z], axis=1)

    u, v = rng.uniform(-1.1, 1.1, on_wall), rng.uniform(-1.1, 1.1, on_wall)
    z = 11.0 + 1.5 * np.sin(2.3 * u) + 0.05 * rng.standard_normal(on_wall)
    wall = np.stack([u * tan_x * z, v * tan_y * z, z], axis=1)

    centres = np.array(
        [[-1.2, 0.1, 4.5], [1.0, 0.3, 5.5], [0.1, -0.6, 7.0], [2.4, -0.2, 8.5], [-2.6, -0.4, 8.0]]
    )
    radii = np.array([0.9, 0.8, 1.2, 1.1, 1.4])
    blob = rng.integers(0, 5, on_blobs)
    direction = rng.standard_normal((on_blobs, 3))
    direction /= np.linalg.norm(direction, axis=1, keepdims=True)
    distance = radii[blob] * (1 + 0.04 * rng.standard_normal(on_blobs))
    blobs = centres[blob] + direction * distance[:, None]

    z = 2.0 + 12.0 * rng.random(free)
    x = rng.uniform(-1.15, 1.15, free) * tan_x * z
    y = rng.uniform(-1.15, 1.15, free) * tan_y * z
    floaters = np.stack([x, y, z], axis=1)
    return np.concatenate([ground, wall, blobs, floaters])[rng.permutation(count)]
