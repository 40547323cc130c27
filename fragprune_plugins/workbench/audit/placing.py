"""Where to look at a splat from, of which nothing is known but the splat.

A file does not record where its photographs were taken. Outside something convex, or in front of a
wall, at most half of all directions end on a surface; from inside a room more do. So cameras
go inside where, from the best place, more than half of all directions end on something opaque that
is not close by. A place in the haze of large near Gaussians is no such place. A hollow object that
is closed all round looks like a room: then choose.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Literal

import torch
from scipy.spatial import cKDTree
from torch import Tensor

from fragprune_plugins.engines import Engine
from fragprune_plugins.files.model import Model
from fragprune_plugins.plugins.hooks import drawn_by
from fragprune_plugins.types import RasterInputs, RasterOutputs, Splats, View
from fragprune_plugins.workbench.figures.evaluate import bar
from fragprune_plugins.workbench.scenes.generated import Named, around, bounds, within
from fragprune_plugins.workbench.scenes.pinhole import look_at

Side = Literal["auto", "orbit", "inside"]  # where cameras go: ``auto`` chooses
ENCLOSED = 0.5  # share of directions that end on a surface from which on a place is inside
_AS_ASKED = "As asked for."
_CANDIDATES = 12
_PLACES = 4  # that cameras stand at, at most
_AS_GOOD = 0.8  # of the best place's share
_GRID = 9  # places along each side of the box
_BOX = 0.1  # share of the Gaussians left out at each of its ends
_APART = 0.2  # distance of candidates, in radii of the splat
_NEAR = 0.2  # likewise: nearer surfaces are not looked at, but stood before
_SOLID = 0.1  # opacity of a Gaussian that is not air
_NEIGHBOURS = 8  # so many Gaussians are a surface, and fewer float
_SAMPLED = 200_000  # Gaussians that are searched for air
_OPAQUE = 0.9
_PIXELS = 32  # side of each of the six pictures of a candidate
_AHEAD = ((1, 0, 0), (-1, 0, 0), (0, 0, 1), (0, 0, -1), (0, 1, 0.01), (0, -1, 0.01))


@dataclass(frozen=True)
class Placed:
    """Cameras that were placed, and why there."""

    views: Named
    side: str  # "orbit" or "inside"
    why: str
    enclosed: float | None = None  # share of directions that end on a surface, from the best place


@torch.no_grad()
def place(
    splat: Model, count: int, engine: Engine, *, side: Side = "auto", divide: int = 1
) -> Placed:
    """Cameras all around a splat, or inside of it, by small pictures that an engine draws.

    The sides of their pictures have 800 pixels, divided by ``divide``.
    """
    pixels = 800 // divide
    if side == "orbit":
        return Placed(_orbit(splat, count, pixels, engine), side, _AS_ASKED)
    splats, near = splat.splats(), _NEAR * bounds(splat)[1]
    places = _clear(splat, near / _NEAR)
    shares = [enclosed(engine, splats, at, near) for at in bar(places, "looking from inside")]
    best = max(shares)
    if side == "auto" and best <= ENCLOSED:
        why = (
            f"This looks like an object: from the most open place inside, {best:.0%} of all "
            f"directions end on a distant surface, and in a room more than {ENCLOSED:.0%} do. "
            "If it is a room, pass --inside."
        )
        return Placed(_orbit(splat, count, pixels, engine), "orbit", why, best)
    why = _AS_ASKED
    if side == "auto":
        why = (
            f"This looks like a room: from the best place inside, {best:.0%} of all directions end "
            f"on a distant surface, and outside an object at most {ENCLOSED:.0%} do. If it is a "
            "hollow object, pass --orbit."
        )
    good = [at for at, share in zip(places, shares, strict=True) if share >= _AS_GOOD * best]
    views = within(good[:_PLACES], 2 * count, pixels=pixels)  # from the most open ones
    tried = bar(views, "choosing cameras")
    seen = [float(_met(engine, splats, _small(view), near).mean()) for _, view in tried]
    half = sorted(seen, reverse=True)[count - 1]  # doors and open sides show nothing
    chosen = [view for view, share in zip(views, seen, strict=True) if share >= half]
    return Placed(chosen[:count], "inside", why, best)


def _orbit(splat: Model, count: int, pixels: int, engine: Engine) -> Named:
    """Cameras all around; from above first (COLMAP has y down), the one that sees most."""
    centre, splats = bounds(splat)[0], splat.splats()
    named = around(splat, count, pixels=pixels)
    details = {n: _detail(engine, splats, view) for n, view in bar(named, "choosing cameras")}
    return sorted(named, key=lambda each: (bool(each[1].campos[1] > centre[1]), -details[each[0]]))


def _detail(engine: Engine, splats: Splats, view: View) -> float:
    """How full a small picture is, and how much pixels differ: backs of walls show little."""
    out = _drawn(engine, splats, _small(view))
    image = out.image.clamp(0, 1)
    differ = sum(float(image.diff(dim=dim).abs().mean()) for dim in (1, 2))
    return differ * float(out.alpha.mean())


def _small(view: View) -> View:
    return replace(view, width=_PIXELS, height=_PIXELS)


def _drawn(engine: Engine, splats: Splats, view: View) -> RasterOutputs:
    return drawn_by(engine, RasterInputs(view.to(splats.device), splats), None)


def _clear(splat: Model, radius: float) -> list[Tensor]:
    """Places of a grid far from all but faint Gaussians and from each other, farthest first."""
    means = splat.xyz.detach().cpu()
    means = means[:: max(1, len(means) // _SAMPLED)]
    ends = torch.quantile(means, torch.tensor([_BOX, 1 - _BOX]), dim=0)
    step = torch.linspace(0, 1, _GRID)
    grid = torch.cartesian_prod(step, step, step) * (ends[1] - ends[0]) + ends[0]
    solid = splat.opacity.detach().cpu()[:: max(1, len(splat) // _SAMPLED), 0].sigmoid() > _SOLID
    tree = cKDTree((means[solid] if solid.any() else means).numpy())
    away, _ = tree.query(grid.numpy(), k=[min(_NEIGHBOURS, tree.n)])
    chosen: list[Tensor] = []
    for at in torch.from_numpy(away[:, 0]).argsort(descending=True, stable=True).tolist():
        if all(float((grid[at] - other).norm()) > _APART * radius for other in chosen):
            chosen.append(grid[at])
        if len(chosen) == _CANDIDATES:
            break
    return chosen


def enclosed(engine: Engine, splats: Splats, place: Tensor, near: float) -> float:
    """Share of directions from a place (3,) that end on something opaque beyond a distance: the
    harmonic mean of a pixel's fragments' by weight, so a large thin Gaussian in front is near.
    """
    at = (torch.arange(_PIXELS) + 0.5) / _PIXELS * 2 - 1
    # What a pixel of such a view sees of the sphere, up to a factor.
    angles = (1 + at[:, None] ** 2 + at**2).pow(-1.5).flatten()
    eye = place.double().cpu()
    ahead = [eye + eye.new_tensor(each) for each in _AHEAD]
    faces = [look_at(eye, at, width=_PIXELS, height=_PIXELS, fov_y=90) for at in ahead]
    met = [float((_met(engine, splats, view, near) * angles).sum()) for view in faces]
    return sum(met) / (len(met) * float(angles.sum()))


def _met(engine: Engine, splats: Splats, view: View, near: float) -> Tensor:
    """(P,) 1 where a pixel shows something opaque beyond a distance, else 0; on the CPU."""
    out = _drawn(engine, splats, view)
    return ((out.alpha > _OPAQUE) & (out.alpha > near * out.invdepth)).flatten().float().cpu()
