"""Makes textures of the demo room from scikit-image's photographs and from seeded noise."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import skimage
from numpy.typing import NDArray
from PIL import Image

Texture = NDArray[np.float32]
"""(H, W, 3) linear RGB that wraps around."""


def linear(srgb: NDArray[np.float32]) -> NDArray[np.float32]:
    """Convert display values to linear light by a power of 2.2; ``displayed`` is the inverse."""
    return np.power(srgb, np.float32(2.2))


def displayed(light: NDArray[np.float32]) -> NDArray[np.float32]:
    """Convert linear light to display values in [0, 1]."""
    return np.power(np.clip(light, 0, 1), np.float32(1 / 2.2))


def colour(red: float, green: float, blue: float) -> Texture:
    """One display colour as a (1, 1, 3) texture."""
    return linear(np.array([[[red, green, blue]]], dtype=np.float32))


def photograph(name: str, size: int, rng: np.random.Generator) -> Texture:
    """A photograph from scikit-image's package, (size, size, 3); noise if the file is missing.

    It reads the installed file and downloads nothing.
    """
    path = Path(skimage.__file__).parent / "data" / name
    if not path.is_file():
        return noise(size, rng) * colour(0.8, 0.7, 0.6)
    with Image.open(path) as image:
        side = min(image.size)
        left, top = (image.width - side) // 2, (image.height - side) // 2
        square = image.convert("RGB").crop((left, top, left + side, top + side))
        small = square.resize((size, size), Image.Resampling.LANCZOS)
    return linear((np.asarray(small, dtype=np.float32) / 255).astype(np.float32))


def noise(size: int, rng: np.random.Generator, contrast: float = 0.5) -> Texture:
    """Seamless grey fractal noise around 1, (size, size, 3)."""
    total = np.zeros((size, size), dtype=np.float32)
    cells, weight = 4, 1.0
    while cells <= size:
        grid = rng.standard_normal((cells, cells)).astype(np.float32)
        total += weight * np.roll(_enlarge(grid, size), size // 3, (0, 1))
        cells, weight = cells * 2, weight * 0.6
    total *= contrast / np.abs(total).max()
    return np.repeat((1 + total)[..., None], 3, axis=2)


def planks(size: int, rng: np.random.Generator) -> Texture:
    """Six wooden boards along the first axis, wavy grain and dark joints, (size, size, 3)."""
    count = 6
    v, u = np.mgrid[0:size, 0:size].astype(np.float32) / size
    board = np.floor(u * count).astype(int)
    shade = rng.uniform(0.7, 1.15, count).astype(np.float32)[board]
    wave = noise(size, rng, 1.0)[..., 0] - 1
    shift = rng.uniform(0, 1, count).astype(np.float32)[board]
    # A whole number of periods makes the grain seamless along the board.
    along = np.sin(2 * np.pi * (v + shift))
    grain = 0.88 + 0.12 * np.sin(2 * np.pi * (u * count * 5 + 0.5 * along + 1.5 * wave))
    across = u * count - board
    joint = np.where((across < 0.03) | (across > 0.97), 0.35, 1.0)
    joint = np.where(np.abs((v + shift) % 1 - 0.5) < 0.004, 0.35, joint)
    tint = linear(np.array([0.76, 0.56, 0.37], dtype=np.float32))
    boards: Texture = (shade * grain * joint).astype(np.float32)[..., None] * tint
    return boards


def stripes(size: int, colours: list[Texture], rng: np.random.Generator) -> Texture:
    """Woven stripes of equal width across the first axis, (size, size, 3)."""
    index = np.arange(size) * len(colours) // size
    rows = np.stack([c[0, 0] for c in colours])[index]
    cloth: Texture = rows[:, None, :] * noise(size, rng, 0.45)
    return cloth


def checker(size: int, first: Texture, second: Texture, count: int = 2) -> Texture:
    """A chequerboard (size, size, 3) of ``count`` squares a side; an even count wraps around."""
    cell = np.arange(size) * count // size
    odd = ((cell[:, None] + cell[None, :]) % 2).astype(bool)
    squares: Texture = np.where(odd[..., None], first[0, 0], second[0, 0])
    return squares


def sample(texture: Texture, u: NDArray[np.float32], v: NDArray[np.float32]) -> Texture:
    """Sample (n, 3) bilinearly at u (n,) to the right and v (n,) up; a repeat is one unit."""
    height, width = texture.shape[:2]
    if height == width == 1:
        return np.broadcast_to(texture[0, 0], (len(u), 3))
    x, y = u * width - 0.5, -v * height - 0.5
    x0, y0 = np.floor(x), np.floor(y)
    fx, fy = (x - x0)[:, None], (y - y0)[:, None]
    left, top = x0.astype(np.int32) % width, y0.astype(np.int32) % height
    right, bottom = (left + 1) % width, (top + 1) % height
    flat = texture.reshape(-1, 3)
    upper = flat[top * width + left] * (1 - fx) + flat[top * width + right] * fx
    lower = flat[bottom * width + left] * (1 - fx) + flat[bottom * width + right] * fx
    mixed: Texture = upper * (1 - fy) + lower * fy
    return mixed


def _enlarge(grid: NDArray[np.float32], size: int) -> NDArray[np.float32]:
    """Resample a grid that wraps around to (size, size) with smooth interpolation."""
    at = np.arange(size) / size * len(grid)
    low = np.floor(at).astype(int)
    part = (at - low).astype(np.float32)
    part = part * part * (3 - 2 * part)
    high = (low + 1) % len(grid)
    rows = grid[low] * (1 - part)[:, None] + grid[high] * part[:, None]
    columns: NDArray[np.float32] = rows[:, low] * (1 - part) + rows[:, high] * part
    return columns
