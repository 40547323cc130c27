"""Cameras that nobody took a photograph with: around a splat, inside of it, near given ones.

They are the same for the same seed. Cameras around a splat suit an object. Inside one they need
free space, which the file does not record: ``audit.placing`` estimates it. A model's own pictures
from them, what it showed as it came in, serve instead of photographs.
"""

from __future__ import annotations

import math
import random
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, ClassVar

import torch
from scipy.spatial.transform import Rotation
from torch import Tensor

from fragprune_plugins.constants import NEAR
from fragprune_plugins.engines import Engine
from fragprune_plugins.errors import DatasetError
from fragprune_plugins.files.model import Model
from fragprune_plugins.plugins.hooks import drawn_by, engine_for
from fragprune_plugins.types import RasterInputs, View, one_line
from fragprune_plugins.workbench.models import model as models
from fragprune_plugins.workbench.scenes import dataset, pinhole, posed

Named = list[tuple[str, View]]  # names of views, and the views
ORBIT_VIEWS = 96  # cameras that ``around`` gives by default
_SHOWN = 0.9  # share of the Gaussians that an orbit goes around: some float far out
_GOLDEN_ANGLE = math.pi * (3 - math.sqrt(5))
_NEARER = (0.6, 1.0)  # of the distance that shows them all: viewers zoom
_FOV, _WIDE = 50.0, 75.0  # degrees; rooms are looked at with wide lenses
_LEVEL = 0.5  # sine of the steepest look from inside: 30 degrees
_NEIGHBOURS = 4
_BETWEEN = (0.1, 0.9)  # of the way; nearer to a camera is its own picture again
_ASIDE = 5  # cameras beside each photograph's
_BESIDE = (-0.6, 0.6)  # of the way; visitors leave the path of the photographs on both sides


def bounds(splat: Model) -> tuple[Tensor, float]:
    """Where most of a splat is: the median of the means (3,), on the CPU, and the radius of nine
    tenths around it, world units above 0.
    """
    means = splat.xyz.detach().cpu()
    centre = means.median(dim=0).values
    distances = (means - centre).norm(dim=1)
    radius = float(distances.kthvalue(math.ceil(_SHOWN * len(means))).values)
    return centre, max(radius, 1e-3)


def not_too_near(distance: float, radius: float, fov: float) -> tuple[float, float]:
    """A distance and a field of view, degrees, at which a splat of this radius is drawn whole.

    Nothing nearer than ``NEAR`` is drawn: of a splat that is small in its world a part would be
    missing, or all. From farther away a narrower lens shows it at the same size.
    """
    farther = max(distance, radius + NEAR)
    half = math.atan(math.tan(math.radians(fov) / 2) * distance / farther)
    return farther, math.degrees(2 * half)


def around(
    splat: Model,
    count: int = ORBIT_VIEWS,
    *,
    pixels: int = 800,
    background: Tensor | None = None,
    seed: int = 0,
) -> Named:
    """Cameras all around a splat, evenly spread over a sphere; from below, too.

    They look at its robust centre from where nine tenths of it fill the picture, or from nearer;
    at a small splat from farther away, through a narrower lens. ``pixels`` are those of a side.
    """
    stream = random.Random(seed)
    centre, radius = bounds(splat)
    square: dict[str, Any] = {"width": pixels, "height": pixels, "background": background}
    views = []
    for number in range(count):
        far = radius / math.sin(math.radians(_FOV) / 2) * stream.uniform(*_NEARER)
        far, fov = not_too_near(far, radius, _FOV)
        eye = centre + far * _direction(number, count)
        views.append((f"around{number:03d}", pinhole.look_at(eye, centre, fov_y=fov, **square)))
    return views


def within(places: Sequence[Tensor], count: int, *, pixels: int = 800) -> Named:
    """Cameras at places (3,) inside a splat, in turns: to all sides, a little up and down."""
    views = []
    for number in range(count):
        eye = places[number % len(places)].detach().float().cpu()
        ahead = eye + _direction(number, count, _LEVEL)
        view = pinhole.look_at(eye, ahead, width=pixels, height=pixels, fov_y=_WIDE)
        views.append((f"within{number:03d}", view))
    return views


def _direction(number: int, count: int, steepest: float = 1.0) -> Tensor:
    """(3,) one of many directions that are evenly spread over a sphere, or the middle of it."""
    rise, turn = steepest * (1 - (2 * number + 1) / count), number * _GOLDEN_ANGLE
    level = math.sqrt(1 - rise * rise)
    return torch.tensor([level * math.cos(turn), rise, level * math.sin(turn)])


def between(cameras: Named, *, seed: int = 0) -> Named:
    """Cameras between each given one and up to four near it, in place and in what they look at."""
    stream = random.Random(seed)
    return [
        (f"{name}~{cameras[j][0]}", interpolate(view, cameras[j][1], stream.uniform(*_BETWEEN)))
        for (name, view), near in zip(cameras, _neighbours(cameras), strict=True)
        for j in near
    ]


def beside(cameras: Named, count: int, *, seed: int = 0) -> Named:
    """Cameras next to given ones, in turns, on the way to one nearby or away from it, if any is."""
    stream, found = random.Random(seed), []
    near = [(i, others) for i, others in enumerate(_neighbours(cameras)) if others]
    for turn in range(count if near else 0):
        i, others = near[turn % len(near)]
        other = cameras[stream.choice(others)][1]
        view = interpolate(cameras[i][1], other, stream.uniform(*_BESIDE))
        found.append((f"{cameras[i][0]}~{turn // len(near)}", view))
    return found


def views_near(shots: Sequence[dataset.Shot], *, seed: int = 0) -> list[View]:
    """The views of photographs, on one device, and five beside each: what a visitor may see.

    There are none beside them if no two photographs look the same way.
    """
    named = [(shot.name, shot.view) for shot in dataset.shots_of("views_near", shots)]
    return [view for _, view in (*named, *beside(named, _ASIDE * len(named), seed=seed))]


def _neighbours(cameras: Named) -> list[list[int]]:
    """Of each camera those near it, in place and in what they look at, the nearest first."""
    views = [view for _, view in cameras]
    if len(views) < 2:
        return [[] for _ in views]
    centres = torch.stack([view.campos for view in views])
    looks = torch.stack([view.viewmatrix[:3, 2] for view in views])
    apart = torch.cdist(centres, centres)
    typical = float(apart[~torch.eye(len(views), dtype=torch.bool)].median())
    agree = looks @ looks.T
    apart = apart / max(typical, 1e-9) + 1 - agree
    apart[agree < 0] = math.inf  # the way there would look at what neither sees
    nearest = apart.fill_diagonal_(math.inf).argsort(dim=1)[:, :_NEIGHBOURS]
    return [[j for j in near if apart[i, j] < math.inf] for i, near in enumerate(nearest.tolist())]


def interpolate(a: View, b: View, t: float) -> View:
    """The camera at ``t`` of the way from one to another, with the lens and picture of the first.

    Its centre lies on the straight line between theirs; its rotation is the spherical interpolation
    of theirs, the short way round. Outside 0 to 1 it goes straight on and turns on.
    """
    one, other = (view.viewmatrix.detach().double().cpu() for view in (a, b))
    ends = Rotation.from_matrix([one[:3, :3].T.numpy(), other[:3, :3].T.numpy()])
    turn = Rotation.from_rotvec(t * (ends[0].inv() * ends[1]).as_rotvec())
    rotation = torch.from_numpy((ends[0] * turn).as_matrix())
    centre = torch.lerp(a.campos.double().cpu(), b.campos.double().cpu(), t)
    view = torch.eye(4, dtype=torch.float64)
    view[:3, :3] = rotation.T
    view[3, :3] = -rotation @ centre
    return moved(a, view, centre)


def moved(view: View, viewmatrix: Tensor, campos: Tensor) -> View:
    """The view with its lens and picture, from where another pose is."""
    lens = torch.linalg.solve(view.viewmatrix.double(), view.projmatrix.double())  # camera to clip
    matrix = viewmatrix.to(lens)
    pose, seen = matrix.to(view.viewmatrix), (matrix @ lens).to(view.projmatrix)
    return replace(view, viewmatrix=pose, projmatrix=seen, campos=campos.to(view.campos))


@dataclass(frozen=True, eq=False)
class OwnPicture(dataset.Shot):
    """A camera, and the picture that a model gives there.

    It is drawn at every use: a forward pass more in a step costs less than to hold the pictures of
    hundreds of views, and rounds nothing.
    """

    target: ClassVar[str] = "itself"

    draw: Callable[[View], Tensor]  # (3, H, W)

    __repr__ = one_line

    @property
    def image(self) -> Tensor:
        """(3, H, W) RGB on the view's device, not clamped."""
        return self.draw(self.view)


def own_pictures(
    model: Model | models.Trained | str | Path,
    cameras: Named | None = None,
    held_out: Named | None = None,
    *,
    engine: str | Engine = "auto",
    seed: int = 0,
) -> dataset.Dataset:
    """A model's own pictures, to learn its thresholds from without photographs.

    It is drawn as it came in: untruncated, or truncated by the thresholds that it has.

    Args:
        model: what ``load`` gave, the result of a training, or a file. It is kept.
        cameras: named views to learn from; views between near ones are added. None takes cameras
            all around the splat, which suit an object but no scene seen from within.
        held_out: named views for the figures; every eighth of ``cameras`` when None.
        engine: a name or an engine.
        seed: of what is generated.

    Raises:
        DatasetError: fewer than two cameras.
        EngineError: no such engine here.
    """
    model = models.of(model)
    drawer, splats, thresholds = engine_for(engine, model.device), model.splats(), model.falloff

    @torch.no_grad()
    def draw(view: View) -> Tensor:
        inputs = RasterInputs(view, splats, planes=(), **model.rules)
        return drawn_by(drawer, inputs, thresholds).image

    views = around(model, seed=seed) if cameras is None else cameras
    if held_out is None:
        if len(views) < 2:
            expected = "at least two: the first of each eight is held out for the figures"
            raise DatasetError("cameras", f"{len(views)}", expected, "Pass more cameras.")
        views, held_out = posed.hold_out(views)
    parts = ([*views, *between(views, seed=seed)], held_out)
    train, test = ([OwnPicture(name, view, draw) for name, view in part] for part in parts)
    return dataset.Dataset(train, test).to(model.device)
