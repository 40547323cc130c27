"""Point clouds and camera matrices (row vectors act from the left: matrices are transposed)."""

import math
from typing import NamedTuple

import numpy as np
import torch


class BasicPointCloud(NamedTuple):
    """Points (n, 3), colours (n, 3) in [0, 1] and normals (n, 3)."""

    points: np.ndarray
    colors: np.ndarray
    normals: np.ndarray


def world_to_view(rotation, translation):
    """Transposed matrix (4, 4) of a world-to-camera rotation (3, 3) and translation (3,)."""
    matrix = torch.eye(4)
    matrix[:3, :3] = torch.as_tensor(rotation, dtype=torch.float32).T
    matrix[3, :3] = torch.as_tensor(translation, dtype=torch.float32)
    return matrix


def projection(fov_x, fov_y, near=0.01, far=100.0):
    """Transposed matrix (4, 4) of a symmetric frustum; it maps depth to [0, 1]."""
    matrix = torch.zeros(4, 4)
    matrix[0, 0] = 1 / math.tan(fov_x / 2)
    matrix[1, 1] = 1 / math.tan(fov_y / 2)
    matrix[2, 2] = far / (far - near)
    matrix[3, 2] = -far * near / (far - near)
    matrix[2, 3] = 1.0
    return matrix


def focal2fov(focal, pixels):
    """Field of view in radians of a focal length in pixels."""
    return 2 * math.atan(pixels / (2 * focal))


def fov2focal(fov, pixels):
    """Focal length in pixels of a field of view in radians."""
    return pixels / (2 * math.tan(fov / 2))
