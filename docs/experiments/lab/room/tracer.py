"""A small ray caster for boxes, balls and poles under one sun, with hard shadows.

Rays are (3, n) float32, coordinate first. Each shape is intersected with all rays at once. numpy
releases the interpreter's lock meanwhile, so several threads can trace views in parallel.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from lab.room.textures import Texture, sample

Array = NDArray[np.float32]
FAR = np.float32(1e6)
_SKIN = np.float32(1e-3)  # a shadow ray starts this far off the surface, world units


def times(matrix: Array, rays: Array) -> Array:
    """``matrix @ rays``, (m, 3) or (3,) by (3, n), without BLAS and its many threads."""
    product: Array = np.einsum("...j,jn->...n", matrix, rays)
    return product


@dataclass(frozen=True)
class Material:
    """The look of a surface.

    Attributes:
        texture: (H, W, 3) linear RGB.
        repeat: world units per repeat; 0 stretches the texture once over each face.
        gloss: strength of the sun's highlight; 0 is matt.
        glow: additional brightness, as a factor of the texture.
    """

    texture: Texture
    repeat: float = 0.0
    gloss: float = 0.0
    glow: float = 0.0


class Shape(Protocol):
    """A shape that rays can hit."""

    @property
    def material(self) -> Material:
        """The look of the surface."""

    def bound(self) -> tuple[Array, float]:
        """Centre (3,) and radius of a ball that contains the shape."""

    def distance(self, origin: Array, direction: Array) -> Array:
        """Distance (n,) at which rays (3, n) enter the shape; FAR for rays that miss it."""

    def surface(self, point: Array) -> tuple[Array, Array, Array]:
        """Normal (3, n) and texture coordinates u (n,), v (n,) of points on the surface."""


@dataclass(frozen=True)
class Box:
    """A cuboid, rotated about the vertical.

    Attributes:
        centre: (x, y, z) in world units.
        half: half of each edge in world units.
        material: look of all six faces.
        yaw: angle of the rotation in degrees.
    """

    centre: tuple[float, float, float]
    half: tuple[float, float, float]
    material: Material
    yaw: float = 0.0
    _turn: Array = field(init=False, repr=False)

    def __post_init__(self) -> None:
        c, s = np.cos(np.radians(self.yaw)), np.sin(np.radians(self.yaw))
        turn = np.array([[c, s, 0], [-s, c, 0], [0, 0, 1]], dtype=np.float32)
        object.__setattr__(self, "_turn", turn)

    def _local(self, point: Array) -> Array:
        return times(self._turn, point - np.array(self.centre, dtype=np.float32)[:, None])

    def bound(self) -> tuple[Array, float]:
        """Centre (3,) and radius of the ball through the corners."""
        return np.array(self.centre, dtype=np.float32), float(np.linalg.norm(self.half))

    def distance(self, origin: Array, direction: Array) -> Array:
        """Distance (n,) by the slab test; FAR for rays that miss the box."""
        start, half = self._local(origin), np.array(self.half, dtype=np.float32)[:, None]
        ray = times(self._turn, direction)
        inverse = 1 / np.where(np.abs(ray) < 1e-9, np.float32(1e-9), ray)
        middle, reach = -start * inverse, half * np.abs(inverse)
        enter, leave = (middle - reach).max(axis=0), (middle + reach).min(axis=0)
        return np.where((enter < leave) & (enter > 0), enter, FAR)

    def surface(self, point: Array) -> tuple[Array, Array, Array]:
        """Normal (3, n) and texture coordinates u, v of the nearest face."""
        local, half = self._local(point), np.array(self.half, dtype=np.float32)[:, None]
        axis = np.argmin(np.abs(np.abs(local) - half), axis=0)
        every = np.arange(point.shape[1])
        sign = np.sign(local[axis, every])
        normal = np.zeros_like(local)
        normal[axis, every] = sign
        # The texture is upright on the sides, and seen from above on the top.
        across, up = np.where(axis == 0, 1, 0), np.where(axis == 2, 1, 2)
        mirror = np.where(axis == 0, sign, np.where(axis == 1, -sign, 1.0))
        u, v = local[across, every] * mirror, local[up, every]
        if self.material.repeat:
            u, v = u / self.material.repeat, v / self.material.repeat
        else:
            u = 0.5 + 0.5 * u / half[across, 0]
            v = 0.5 + 0.5 * v / half[up, 0]
        return times(self._turn.T, normal), u.astype(np.float32), v.astype(np.float32)


@dataclass(frozen=True)
class Ball:
    """A sphere.

    Attributes:
        centre: (x, y, z) in world units.
        radius: radius in world units.
        material: the look; its texture repeats twice around, and once from pole to pole.
    """

    centre: tuple[float, float, float]
    radius: float
    material: Material

    def bound(self) -> tuple[Array, float]:
        """Centre (3,) and radius of the ball."""
        return np.array(self.centre, dtype=np.float32), self.radius

    def distance(self, origin: Array, direction: Array) -> Array:
        """Distance (n,) by the quadratic's nearest root; directions are unit vectors."""
        start = origin - np.array(self.centre, dtype=np.float32)[:, None]
        b = (start * direction).sum(axis=0)
        c = (start * start).sum(axis=0) - np.float32(self.radius**2)
        inside = b * b - c
        t = -b - np.sqrt(np.maximum(inside, 0))
        return np.where((inside > 0) & (t > 0), t, FAR)

    def surface(self, point: Array) -> tuple[Array, Array, Array]:
        """Normal (3, n), and longitude and latitude as u, v."""
        normal = (point - np.array(self.centre, dtype=np.float32)[:, None]) / self.radius
        u = np.arctan2(normal[1], normal[0]) / np.pi
        v = np.arcsin(np.clip(normal[2], -1, 1)) / np.pi
        return normal, u, v


@dataclass(frozen=True)
class Pole:
    """A cylinder without caps, in any direction.

    Attributes:
        start: (x, y, z) of one end.
        end: (x, y, z) of the other end.
        radius: radius in world units.
        material: the look; its texture repeats every ``repeat`` units along, and once around.
    """

    start: tuple[float, float, float]
    end: tuple[float, float, float]
    radius: float
    material: Material

    def _axis(self) -> tuple[Array, Array, np.float32]:
        base = np.array(self.start, dtype=np.float32)[:, None]
        along = np.array(self.end, dtype=np.float32)[:, None] - base
        length = np.float32(np.linalg.norm(along))
        return base, along / length, length

    def bound(self) -> tuple[Array, float]:
        """Centre (3,) and radius of a ball around the middle."""
        base, axis, length = self._axis()
        return (base + axis * (length / 2))[:, 0], float(length) / 2 + self.radius

    def distance(self, origin: Array, direction: Array) -> Array:
        """Distance (n,) by the quadratic across the axis and a test of the height."""
        base, axis, length = self._axis()
        start = origin - base
        rise, height = (direction * axis).sum(axis=0), (start * axis).sum(axis=0)
        across, offset = direction - axis * rise, start - axis * height
        a = np.maximum((across * across).sum(axis=0), np.float32(1e-9))
        b = (across * offset).sum(axis=0)
        c = (offset * offset).sum(axis=0) - np.float32(self.radius**2)
        inside = b * b - a * c
        t = (-b - np.sqrt(np.maximum(inside, 0))) / a
        at = height + t * rise
        return np.where((inside > 0) & (t > 0) & (at > 0) & (at < length), t, FAR)

    def surface(self, point: Array) -> tuple[Array, Array, Array]:
        """Normal (3, n), and the angle and the height along the axis as u, v."""
        base, axis, _ = self._axis()
        height = ((point - base) * axis).sum(axis=0)
        normal = (point - base - axis * height) / self.radius
        u = np.arctan2(normal[1], normal[0] + 1e-6) / (2 * np.pi)
        return normal, u.astype(np.float32), height / (self.material.repeat or 1.0)


@dataclass(frozen=True)
class World:
    """Shapes under a sun.

    Attributes:
        shapes: the shapes, in any order.
        sun: (3,) unit vector towards the sun.
        sun_colour: (3,) linear RGB.
        sky_colour: (3,) ambient light from above, linear RGB.
        ground_colour: (3,) ambient light from below, linear RGB.
    """

    shapes: tuple[Shape, ...]
    sun: Array
    sun_colour: Array
    sky_colour: Array
    ground_colour: Array

    def hit(self, origin: Array, direction: Array) -> tuple[Array, NDArray[np.int32]]:
        """Trace rays (3, n) from one point (3, 1) to the first surface.

        Returns:
            Distances (n,), FAR for none, and indices of the shapes (n,), -1 for none.
        """
        nearest = np.full(direction.shape[1], FAR, dtype=np.float32)
        which = np.full(direction.shape[1], -1, dtype=np.int32)
        for index, shape in enumerate(self.shapes):
            centre, radius = shape.bound()
            offset = centre - origin[:, 0]
            beside = offset @ offset - times(offset, direction) ** 2  # squared distance of the ray
            near = np.flatnonzero(beside < 1.001 * radius**2)
            t = shape.distance(origin, direction[:, near])
            closer = t < nearest[near]
            nearest[near[closer]] = t[closer]
            which[near[closer]] = index
        return nearest, which

    def colour(self, origin: Array, direction: Array) -> Array:
        """Linear RGB (3, n) along rays (3, n) from one point (3, 1); the sky if nothing is hit."""
        t, which = self.hit(origin, direction)
        seen = np.repeat(self.sky_colour[:, None], direction.shape[1], axis=1)
        drawn = np.flatnonzero(which >= 0)
        ray = direction[:, drawn]
        point = origin + ray * t[drawn]
        seen[:, drawn] = self.shade(point, which[drawn], ray)
        return seen

    def shade(self, point: Array, which: NDArray[np.int32], ray: Array) -> Array:
        """Linear RGB (3, n) of surface points (3, n) of shapes (n,), seen along ``ray`` (3, n)."""
        normal, albedo, extra = np.empty_like(point), np.empty_like(point), np.empty_like(point)
        for index in np.unique(which):
            mine, shape = which == index, self.shapes[index]
            normal[:, mine], u, v = shape.surface(point[:, mine])
            albedo[:, mine] = sample(shape.material.texture, u, v).T
            mirror = ray[:, mine] - 2 * (ray[:, mine] * normal[:, mine]).sum(0) * normal[:, mine]
            shine = np.maximum(times(self.sun, mirror), 0) ** 12
            extra[:, mine] = shape.material.gloss * shine
            albedo[:, mine] *= 1 + shape.material.glow
        facing = times(self.sun, normal)
        toward = np.flatnonzero(facing > 0)
        lit = np.zeros(point.shape[1], dtype=np.float32)
        lit[toward] = ~self.shadowed(point[:, toward] + _SKIN * normal[:, toward])
        up = (0.5 + 0.5 * normal[2])[None]
        ambient = self.sky_colour[:, None] * up + self.ground_colour[:, None] * (1 - up)
        direct = self.sun_colour[:, None] * (lit * np.maximum(facing, 0))
        seen: Array = albedo * (ambient + direct) + extra * lit * self.sun_colour[:, None]
        return seen

    def shadowed(self, point: Array) -> NDArray[np.bool_]:
        """(n,) bool: whether a shape is between the points (3, n) and the sun."""
        across = np.linalg.svd(self.sun[None])[2][1:]  # (2, 3): the plane across the sun
        flat = times(across, point)
        dark = np.zeros(point.shape[1], dtype=bool)
        for shape in self.shapes:
            centre, radius = shape.bound()
            beside = ((flat - (across @ centre)[:, None]) ** 2).sum(axis=0)
            near = np.flatnonzero((beside < 1.001 * radius**2) & ~dark)
            dark[near] = shape.distance(point[:, near], self.sun[:, None]) < FAR
        return dark
