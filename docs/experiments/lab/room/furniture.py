"""The demo's room: a corner with a still life, thin poles, sharp shadows and real textures."""

from __future__ import annotations

import numpy as np

from lab.room.textures import Texture, checker, colour, linear, noise, photograph, planks, stripes
from lab.room.tracer import Ball, Box, Material, Pole, Shape, World

CENTRE = (-0.15, -0.15, 0.6)
"""The point at which the cameras look, in world units; z is up."""

_TEXELS = 96  # per repeat: not much finer than the photographs' pixels, so that nothing shimmers


def furnish(seed: int = 0) -> World:
    """Build the room; the seed varies grain, stains and the order of the books."""
    rng = np.random.default_rng(seed)
    wood = planks(_TEXELS, rng)
    brick = photograph("brick.png", _TEXELS, rng).transpose(1, 0, 2)  # courses lie flat
    shapes: list[Shape] = [
        *_shell(wood, brick, rng),
        *_table(wood, rng),
        *_floor_things(wood, brick, rng),
        *_screen(),
        *_lamp(rng),
    ]
    sun = np.array([0.62, 0.3, 0.95], dtype=np.float32)
    return World(
        shapes=tuple(shapes),
        sun=sun / np.linalg.norm(sun),
        sun_colour=np.array([1.25, 1.12, 0.92], dtype=np.float32),
        sky_colour=np.array([0.42, 0.48, 0.58], dtype=np.float32),
        ground_colour=np.array([0.3, 0.24, 0.2], dtype=np.float32),
    )


def _paint(red: float, green: float, blue: float, **more: float) -> Material:
    return Material(colour(red, green, blue), **more)


def _shell(wood: Texture, brick: Texture, rng: np.random.Generator) -> list[Shape]:
    """Floor, two walls, skirting, rug, two framed pictures."""
    white = _paint(0.93, 0.91, 0.87)
    plaster = noise(_TEXELS, rng, 0.22) * colour(0.45, 0.66, 0.68)
    bricks = np.clip(brick * 1.9, 0, 1) * linear(np.array([0.96, 0.76, 0.64], dtype=np.float32))
    weave = [
        colour(0.72, 0.2, 0.18),
        colour(0.93, 0.87, 0.74),
        colour(0.13, 0.25, 0.4),
        colour(0.9, 0.66, 0.25),
        colour(0.93, 0.87, 0.74),
        colour(0.13, 0.25, 0.4),
    ]
    frame = _paint(0.2, 0.13, 0.09)
    cat = Material(photograph("chelsea.png", _TEXELS, rng))
    rocket = Material(photograph("rocket.jpg", _TEXELS, rng))
    return [
        Box((2.5, 2.5, -0.1), (4.7, 4.7, 0.1), Material(wood, repeat=1.5)),
        Box((-2.1, 2.5, 1.6), (0.1, 4.7, 1.9), Material(bricks, repeat=1.1)),
        Box((2.5, -2.1, 1.6), (4.7, 0.1, 1.9), Material(plaster, repeat=1.8)),
        Box((-1.98, 2.5, 0.06), (0.02, 4.7, 0.06), white),
        Box((2.5, -1.98, 0.06), (4.7, 0.02, 0.06), white),
        Box((0.1, 0.1, 0.008), (1.25, 0.85, 0.008), Material(stripes(_TEXELS, weave, rng)), 24),
        Box((-0.55, -1.97, 1.5), (0.5, 0.03, 0.5), frame),
        Box((-0.55, -1.94, 1.5), (0.44, 0.012, 0.44), cat),
        Box((-1.97, 0.1, 1.55), (0.03, 0.4, 0.5), frame),
        Box((-1.94, 0.1, 1.55), (0.012, 0.34, 0.44), rocket),
    ]


def _table(wood: Texture, rng: np.random.Generator) -> list[Shape]:
    """A table on four thin legs; books, a stone, a glossy ball, a box with a photograph."""
    top, board = 0.66, Material(wood * np.float32(0.55), repeat=0.8)
    steel = _paint(0.16, 0.17, 0.19)
    shapes: list[Shape] = [Box((-0.35, -0.4, top - 0.025), (0.7, 0.42, 0.025), board, 12)]
    turn = np.radians(12)
    for x, y in ((-0.62, -0.34), (0.62, -0.34), (-0.62, 0.34), (0.62, 0.34)):
        east = -0.35 + x * np.cos(turn) - y * np.sin(turn)
        north = -0.4 + x * np.sin(turn) + y * np.cos(turn)
        shapes.append(Pole((east, north, 0.0), (east, north, top - 0.05), 0.022, steel))
    covers = [(0.78, 0.25, 0.2), (0.95, 0.8, 0.4), (0.2, 0.42, 0.55), (0.36, 0.5, 0.3)]
    height = top
    for index, cover in enumerate(rng.permutation(np.array(covers))):
        book = _paint(float(cover[0]), float(cover[1]), float(cover[2]))
        pages = _paint(0.92, 0.9, 0.82)
        x, yaw = -0.72, 8.0 + 17 * index
        shapes.append(Box((x, -0.5, height + 0.028), (0.175, 0.125, 0.02), pages, yaw))
        for z in (0.004, 0.052):
            shapes.append(Box((x, -0.5, height + z), (0.18, 0.13, 0.004), book, yaw))
        height += 0.057
    stone = Material(photograph("gravel.png", 128, rng) * np.float32(1.5))
    coffee = Material(photograph("coffee.png", 128, rng))
    return [
        *shapes,
        Ball((-0.72, -0.5, height + 0.085), 0.085, _paint(0.85, 0.3, 0.12, gloss=0.25)),
        Box((-0.3, -0.45, top + 0.16), (0.16, 0.16, 0.16), coffee, -20),
        Ball((0.1, -0.2, top + 0.12), 0.12, stone),
    ]


def _floor_things(wood: Texture, brick: Texture, rng: np.random.Generator) -> list[Shape]:
    """A clipped tree in a brick planter, crates, a chequered ball."""
    leaves = photograph("grass.png", 128, rng) * linear(np.array([0.75, 1.0, 0.5], np.float32)) * 2
    clay = brick * np.float32(1.5) * linear(np.array([0.95, 0.62, 0.5], dtype=np.float32))
    bark = _paint(0.35, 0.24, 0.16)
    portrait = Material(photograph("astronaut.png", _TEXELS, rng))
    dots = checker(32, colour(0.94, 0.94, 0.92), colour(0.15, 0.35, 0.62), 8)
    return [
        Box((0.85, -1.25, 0.17), (0.22, 0.22, 0.17), Material(clay, repeat=0.5), 10),
        Pole((0.85, -1.25, 0.3), (0.85, -1.25, 0.9), 0.03, bark),
        Ball((0.85, -1.25, 1.12), 0.36, Material(leaves)),
        Box((-1.35, 0.75, 0.3), (0.3, 0.3, 0.3), portrait, 35),
        Box((-1.38, 0.72, 0.72), (0.16, 0.2, 0.12), Material(wood, repeat=0.6), 70),
        Ball((0.62, 0.3, 0.196), 0.18, Material(dots, gloss=0.1)),
    ]


def _screen() -> list[Shape]:
    """A railing of thin poles, the finest shapes in the room."""
    rod, start, step = _paint(0.95, 0.93, 0.88), np.array([-1.0, 1.2]), np.array([0.1, 0.045])
    shapes: list[Shape] = []
    for index in range(10):
        x, y = (float(c) for c in start + index * step)
        shapes.append(Pole((x, y, 0.0), (x, y, 0.95), 0.014, rod))
    (x0, y0), (x1, y1) = start - 0.4 * step, start + 9.4 * step
    for z in (0.12, 0.95):
        ends = (float(x0), float(y0), z), (float(x1), float(y1), z)
        shapes.append(Pole(*ends, 0.018, _paint(0.62, 0.42, 0.25)))
    return shapes


def _lamp(rng: np.random.Generator) -> list[Shape]:
    """A globe on a thin tripod."""
    brass, foot = _paint(0.72, 0.55, 0.28), np.array([-1.5, -1.45])
    globe = Material(noise(64, rng, 0.15) * colour(1.0, 0.9, 0.68), glow=0.5)
    shapes: list[Shape] = [Ball((-1.5, -1.45, 1.52), 0.2, globe)]
    for angle in (20.0, 140.0, 260.0):
        way = 0.3 * np.array([np.cos(np.radians(angle)), np.sin(np.radians(angle))])
        x, y = (float(c) for c in foot + way)
        shapes.append(Pole((x, y, 0.0), (-1.5, -1.45, 1.38), 0.016, brass))
    return shapes
