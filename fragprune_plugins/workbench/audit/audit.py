"""What a splat costs to draw, and how much of that nobody sees. No photograph is needed.

A fragment is *idle* if the picture may do without it. Two measures, both of single fragments with
their exact weights T alpha, from the reference engine on a sample of tiles:

* *alone*: without this one fragment no channel of its pixel moves by half an 8-bit level.
* *together*: as many of a pixel's fragments as their weights, times the largest colour around, sum
  up to half a level, the least first. Without all of them no channel moves by more than that.

Of a pixel the order of its fragments, and where it ends for lack of light, stay as they are.
"""

from __future__ import annotations

import math
import statistics
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import torch
from torch import Tensor
from tqdm import tqdm

from fragprune_plugins.engines import Engine
from fragprune_plugins.engines.fragments import fragments
from fragprune_plugins.files.model import Model
from fragprune_plugins.learning.schedule import USUAL_STOP
from fragprune_plugins.types import RasterInputs, RasterOutputs, View, one_line
from fragprune_plugins.workbench.figures import evaluate, extents, wording
from fragprune_plugins.workbench.figures.extents import VIEWERS
from fragprune_plugins.workbench.scenes.generated import Named

HALF_LEVEL = 0.5 / 255  # what an 8-bit picture does not show
TILES = 384  # tiles of 16x16 pixels, of all views together, whose fragments are weighed
SHOWN = 3  # views that pictures show and frames are timed on
REPEATS = 5
DARK = 0.05  # a fragment is behind what is opaque if less light than this is left for it
RIM = math.exp(-2.0)  # a fragment is at the rim where the falloff is below this: beyond 2 sigma
FAINT = 0.1  # opacity of a Gaussian that hides little

REASONS = ("behind what is opaque", "at the rim, beyond 2 sigma", "of faint Gaussians", "others")
"""Where an idle fragment sits: the first that is true of it."""

AS_IT_IS = "as it is"
UNTRUNCATED = "without its cutoffs and stop"
HONOURING = "a viewer that knows its cutoffs"
_COUNTS = ("fragments_per_pixel", "evaluated_per_pixel")


@dataclass
class Idle:
    """Counts of weighed fragments: drawn at some pixels, and of them idle alone and together."""

    __repr__ = one_line

    pixels: int = 0
    alone: int = 0
    weight: float = 0.0  # of those idle together, sum; a pixel has 1 at most
    reasons: Tensor = field(default_factory=lambda: torch.zeros(2, 4, dtype=torch.int64))
    """(2, 4) all, and those idle together, by ``REASONS``."""

    def add(self, tile: Any, background: Tensor) -> None:
        """Weigh and count the fragments of a tile."""
        alone, together, reasons = weigh(tile, background)
        self.pixels += tile.drawn.shape[1]
        self.alone += int(alone.sum())
        self.weight += float(tile.weights[together].sum())
        for at, chosen in enumerate((tile.drawn, together)):
            self.reasons[at] += reasons[chosen].bincount(minlength=len(REASONS)).cpu()

    def as_dict(self) -> dict[str, Any]:
        """Shares, as plain values."""
        fragments, together = self.reasons.sum(dim=1).tolist()
        drawn = max(fragments, 1)
        return {
            "bound": HALF_LEVEL,
            "pixels": self.pixels,
            "fragments": fragments,
            "alone": self.alone / drawn,
            "together": together / drawn,
            "light": self.weight / max(self.pixels, 1),
            "reasons": [
                {"name": name, "share": int(every) / drawn, "idle": int(idle) / drawn}
                for name, every, idle in zip(REASONS, *self.reasons, strict=True)
            ],
        }


def weigh(tile: Any, background: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """Judge the fragments of a tile, of 1 Gaussian or more, before a background (3,).

    All (K, P): which are idle alone; which are together; for each the index into ``REASONS``.
    """
    alpha, light, drawn = tile.alpha, tile.light, tile.drawn
    weights = alpha * light
    left = light[-1] * (1 - alpha[-1])
    moved = torch.zeros_like(alpha)
    for channel in range(3):
        given = weights * tile.color[:, channel, None]
        behind = given.flip(0).cumsum(0).flip(0) - given + left * background[channel]
        # Without a fragment, what is behind it shines through: 1 / (1 - alpha) as bright.
        moved = moved.maximum((behind * alpha / (1 - alpha) - given).abs())
    # Without fragments, back to front: each one's weight is still its own, and the colour behind
    # it is a mean of colours there. So none moves its pixel by more than its weight times this.
    reach = torch.maximum(tile.color.max(), background.max())
    bounds = torch.where(drawn, weights * reach, math.inf)
    least = bounds.sort(dim=0)
    spared = least.values.cumsum(0) <= HALF_LEVEL
    together = torch.zeros_like(drawn).scatter(0, least.indices, spared) & drawn
    opacity = tile.opacity[:, None]
    reasons = torch.full_like(alpha, 3, dtype=torch.int64)
    reasons[(opacity < FAINT).expand_as(reasons)] = 2
    reasons[alpha < RIM * opacity] = 1
    reasons[light < DARK] = 0
    return drawn & (moved < HALF_LEVEL), together, reasons


@dataclass(frozen=True)
class Shown:
    """A view whose pictures are kept."""

    __repr__ = one_line

    name: str
    image: Tensor  # (3, H, W)
    fragments: Tensor  # (H, W) drawn
    overdraw: Tensor  # (H, W) ellipses of sqrt(8) standard deviations


@torch.no_grad()
def audit(
    model: Model,
    views: Named,
    *,
    engine: Engine,
    tiles: int = TILES,
    repeats: int = REPEATS,
    progress: bool = False,
) -> tuple[dict[str, Any], list[Shown]]:
    """Measure what a splat, with its thresholds and stop, costs from cameras on its device.

    The fragments of ``tiles`` tiles of all views together are weighed one by one; ``repeats``
    frames of each timed view and cut are timed. Returns figures as plain values, and the views that
    pictures show.
    """
    candidates, idle = _candidates(model), Idle()
    itself = candidates[AS_IT_IS]
    shown, drawn, asked = list[Shown](), [], []
    parts = min(SHOWN, len(views))  # the middle of each is shown: an orbit begins at a pole
    chosen = [(2 * part + 1) * len(views) // (2 * parts) for part in range(parts)]
    for number, (name, view) in enumerate(tqdm(views, "audit", unit="view", disable=not progress)):
        inputs = itself.inputs(view)
        rows, picture = _drawn(candidates, engine, view)
        drawn.append(rows)
        asked.append(_asked(itself, engine, inputs))
        if number in chosen:
            squared = extents.SQRT8.squared(itself.splats.opacities)
            ellipses = extents.covered(engine, replace(inputs, counts=True), squared).fragments
            assert picture.fragments is not None
            assert ellipses is not None
            shown.append(Shown(name, picture.image, picture.fragments, ellipses))
        for tile in fragments(inputs, itself.thresholds(inputs), max(1, tiles // len(views))):
            if len(tile.rows):
                idle.add(tile, view.background)
    timed = [views[number][1] for number in chosen]
    frames = evaluate.frame_times([*candidates.values()], timed, engine, repeats=repeats)
    cuts = [
        {"name": name} | _mean([rows[name] for rows in drawn]) | frame
        for name, frame in zip(candidates, frames, strict=True)
    ]
    viewers = _viewers(asked)
    return {
        "gaussians": len(model),
        "truncated": model.falloff is not None,
        **model.rules,
        "views": len(views),
        "overdraw": math.pi / 4 * viewers[0]["shaded_per_pixel"],  # quads of √8 sigma
        **{key: cuts[0][key] for key in (*_COUNTS, "frame_ms", "frame_ms_se")},
        "frame_size": wording.sizes([(*each.fragments.shape[::-1],) for each in shown]),
        "engine": engine.name,
        "device": str(model.device),
        "idle": idle.as_dict(),
        "cuts": cuts,
        "viewers": viewers,
    }, shown


def _candidates(model: Model) -> dict[str, evaluate.Candidate]:
    """The model as it is, first, and with every cut on top."""
    itself, own = evaluate.Candidate(model), model.falloff
    found = {AS_IT_IS: itself}
    for cut in extents.CUTS:
        thresholds = cut.thresholds(itself.splats.opacities)
        thresholds = thresholds if own is None else torch.maximum(own, thresholds)
        found[cut.name] = itself.sharing(cut=thresholds)
    if model.stop is None:
        found[f"a stop at {USUAL_STOP:g}"] = itself.sharing(model=model.with_rules(stop=USUAL_STOP))
    if model.pruned:
        found[UNTRUNCATED] = evaluate.Candidate(model.untruncated())
    return found


def _drawn(
    candidates: Mapping[str, evaluate.Candidate], engine: Engine, view: View
) -> tuple[dict[str, dict[str, float]], RasterOutputs]:
    """What each candidate draws of a view, with its squared error; and the picture as it is."""
    itself, rows = candidates[AS_IT_IS].draw(engine, view, counts=True), {}
    for name, candidate in candidates.items():
        out = itself if name == AS_IT_IS else candidate.draw(engine, view)
        error = (out.image.clamp(0, 1) - itself.image.clamp(0, 1)).square().mean()
        rows[name] = {key: float(getattr(out, key)) for key in _COUNTS} | {"mse": float(error)}
    return rows, itself


def _asked(itself: evaluate.Candidate, engine: Engine, inputs: RasterInputs) -> dict[str, float]:
    """Pixels that each viewer is asked to shade for one of a view."""
    found = {each.names: extents.shaded(engine, inputs, each) for each in VIEWERS}
    if (cut := itself.thresholds(inputs)) is not None:
        reach = torch.minimum(-2 * cut.log(), 2 * (255 * itself.splats.opacities).log())
        found[HONOURING] = extents.quads(engine, inputs, reach)
    return found


def _mean(rows: Sequence[Mapping[str, float]]) -> dict[str, Any]:
    """Means over views; PSNR of the mean squared error and of the worst view, infinite if equal."""
    errors = [row["mse"] for row in rows]
    ends = {"psnr": statistics.fmean(errors), "worst_psnr": max(errors)}
    return {key: statistics.fmean(row[key] for row in rows) for key in _COUNTS} | {
        key: -10 * math.log10(error) if error else math.inf for key, error in ends.items()
    }


def _viewers(asked: Sequence[Mapping[str, float]]) -> list[dict[str, Any]]:
    """Of each viewer its rule, and the mean over views of what it is asked to shade."""
    rules = {each.names: {"rule": each.extent.name, "shape": each.shape} for each in VIEWERS}
    rules[HONOURING] = {"rule": "quads by cutoffs, 1/255", "shape": "quad"}
    means = {name: statistics.fmean(each[name] for each in asked) for name in asked[0]}
    first, found = means[VIEWERS[0].names], []
    for name, mean in means.items():
        share = {"shaded_per_pixel": mean, "against_sqrt8": mean / first if first else math.nan}
        found.append({"viewers": name, **rules[name], **share})
    return found
