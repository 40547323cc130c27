"""The world into which gsplat's trainer turns, moves and scales a COLMAP scene before it trains.

Its models lie there by default, and their PLYs do not say so.
"""

from __future__ import annotations

import contextlib
from collections.abc import Sequence
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from fragprune_plugins.hosts.photographs import Similarity
from fragprune_plugins.workbench.scenes import colmap
from fragprune_plugins.workbench.scenes.dataset import read_scene
from fragprune_plugins.workbench.scenes.pinhole import DISTANCE_MAX, Camera

Matrix = NDArray[np.float64]
_UP = np.array([0.0, -1.0, 0.0])
_FEWEST = 4  # points that have principal axes
_SIGNS = ((1, 1, 1), (1, -1, -1), (-1, 1, -1), (-1, -1, 1))  # of axes; none mirrors


def worlds(folder: Path, images: str = "images") -> list[Similarity]:
    """Where a scene may lie then: ``Photographs.world``, four, because axes have no sign.

    None of a folder that is no COLMAP scene with points, nor where cameras are all in one place or
    points nowhere.
    """
    points = colmap.points(folder)
    if len(points) < _FEWEST:
        return []
    parts = read_scene(folder, images, split=False)
    with np.errstate(all="ignore"), contextlib.suppress(np.linalg.LinAlgError):
        upright = _upright([row.camera for part in parts for row in part])
        along = _along_axes(points @ upright[:3, :3].T + upright[:3, 3])
        found = [np.diag([*signs, 1.0]) @ along @ upright for signs in _SIGNS]
        if np.abs(found).max() < DISTANCE_MAX:  # False for NaN, too
            return [tuple(tuple(row) for row in each.tolist()) for each in found]
    return []


def _upright(cameras: Sequence[Camera]) -> Matrix:
    """(4, 4) turns the mean of the cameras' up into -y, moves what they look at into the origin,
    and scales their distance from there to 1; both are medians.
    """
    turned = np.stack([each.rotation.double().numpy() for each in cameras])  # world to camera
    moved = np.stack([each.translation.double().numpy() for each in cameras])
    centres = -np.einsum("nji,nj->ni", turned, moved)
    up = -turned[:, 1].mean(axis=0)
    up /= np.linalg.norm(up)
    x, y, z = np.cross(up, _UP)
    skew, cosine = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]]), float(up @ _UP)
    align = np.diag([-1.0, 1.0, 1.0])
    if cosine > -1:
        align = np.eye(3) + skew + skew @ skew / (1 + cosine)
    centres, forward = centres @ align.T, turned[:, 2] @ align.T
    nearest = centres - (forward * centres).sum(axis=1, keepdims=True) * forward
    origin = np.median(nearest, axis=0)
    scale = 1 / np.median(np.linalg.norm(centres - origin, axis=1))
    return _affine(scale * align, -scale * origin)


def _along_axes(points: Matrix) -> Matrix:
    """(4, 4) moves points' median into the origin, and turns their axes by size into x, y, z."""
    centre = np.median(points, axis=0)
    _, axes = np.linalg.eigh(np.cov(points - centre, rowvar=False))
    axes = axes[:, ::-1].copy()
    if np.linalg.det(axes) < 0:
        axes[:, 0] *= -1
    return _affine(axes.T, -axes.T @ centre)


def _affine(turned: Matrix, moved: Matrix) -> Matrix:
    whole = np.eye(4)
    whole[:3, :3], whole[:3, 3] = turned, moved
    return whole
