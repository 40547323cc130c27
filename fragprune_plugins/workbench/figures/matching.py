"""Reads photographs as a model shows them, whatever its training is said to have done."""

from __future__ import annotations

import math
import statistics
from collections.abc import Mapping, Sequence
from dataclasses import replace
from itertools import product

import click

from fragprune_plugins.engines import Engine
from fragprune_plugins.files.model import Model
from fragprune_plugins.hosts.photographs import Photographs
from fragprune_plugins.learning.stage2 import evenly_spaced
from fragprune_plugins.workbench.figures.evaluate import Candidate, psnrs
from fragprune_plugins.workbench.figures.metrics import mean, psnr
from fragprune_plugins.workbench.scenes.dataset import OFF_CENTRE, Dataset, Shot, load_photographs
from fragprune_plugins.workbench.scenes.normalised import worlds

OTHER_SCENE = 3.0
"""dB of PSNR that a model has to be above pictures of one colour each, to be one of the scene.
Trained models of two scenes are by ten or more; one of an object that was moved is at -6 to 3."""

_EQUAL = 100.0  # dB of PSNR: what is left is rounding


def matched(model: Model, read: Photographs, engine: Engine) -> tuple[Photographs, Dataset]:
    """Photographs around the middle or the principal point, with or without alpha, as a model shows
    them best: 3DGS and most of its descendants take the middle, whatever the scene says, and drop
    the alpha of a COLMAP scene's images; others do not. Of a model that shows none of them, in the
    world of gsplat's trainer, if it does there.
    """
    read, dataset = _in_its_world(model, read, engine)
    told = bool(read.centred), read.opaque
    points = (True, False) if dataset.off_centre > OFF_CENTRE else told[:1]
    alphas = (told[1], not told[1]) if dataset.transparent else told[1:]
    ways = {way: dataset.read_as(*way).to(model.device) for way in product(points, alphas)}
    if len(ways) == 1:
        return read, ways[told]
    some = {way: evenly_spaced(each.train, 8) for way, each in ways.items()}
    figures = {way: mean(psnrs(Candidate(model), each, engine)[0]) for way, each in some.items()}
    best, *others = sorted(figures, key=figures.__getitem__, reverse=True)
    unknown = len(points) > 1 and read.centred is None
    if unknown or best != told:
        where = "the middle" if best[0] else "the scene's principal point"
        drawn = [f"is drawn around {where}"] * (len(points) > 1)
        drawn += [f"{'ignores' if best[1] else 'keeps'} the images' alpha"] * (len(alphas) > 1)
        said = f"{figures[best]:.1f} dB, {figures[others[0]]:.1f} otherwise."
        click.echo(f"MODEL {' and '.join(drawn)}: {said}", err=True)
    return replace(read, centred=best[0], opaque=best[1]), ways[best]


def _in_its_world(model: Model, read: Photographs, engine: Engine) -> tuple[Photographs, Dataset]:
    """The photographs, in another world if the model shows them there alone."""
    dataset = load_photographs(replace(read, centred=True))  # nothing is wrong with another point
    if read.world is not None:
        return read, dataset
    shown, plain = shown_and_plain(model, dataset.to(model.device), engine)
    if shown >= plain + OTHER_SCENE:
        return read, dataset
    others = [
        (there, load_photographs(there))
        for there in (
            replace(read, centred=True, world=each) for each in worlds(read.folder, read.images)
        )
    ]
    figures = [shown_and_plain(model, each.to(model.device), engine)[0] for _, each in others]
    best = max(figures, default=shown)
    if best < plain + OTHER_SCENE:
        return read, dataset
    said = "MODEL lies where gsplat's trainer turns and scales a scene to:"
    click.echo(f"{said} {best:.1f} dB, {shown:.1f} otherwise.", err=True)
    there, seen = others[figures.index(best)]
    return replace(read, world=there.world), seen


def told_or_matched(model: Model, read: Photographs, engine: Engine) -> tuple[Photographs, Dataset]:
    """The same, but where its training or a record tells how photographs were read, as it says."""
    if read.centred is None:
        return matched(model, read, engine)
    return read, load_photographs(read).to(model.device)


def shown_and_plain(model: Model, dataset: Dataset, engine: Engine) -> tuple[float, float]:
    """How well a model shows up to eight training pictures, and one colour each: median dB."""
    shots = evenly_spaced(dataset.train, 8)
    return statistics.median(psnrs(Candidate(model), shots, engine)[0]), _plain(shots)


def _plain(shots: Sequence[Shot]) -> float:
    """How well one colour each shows pictures that have more, dB of PSNR, their median."""
    means = ((shot, shot.image.mean(dim=(1, 2), keepdim=True)) for shot in shots)
    figures = [psnr(s.looked_at(colour.expand_as(s.image)), s.image) for s, colour in means]
    return statistics.median([each for each in figures if each < _EQUAL] or [-math.inf])


def hardly_shown(figures: Mapping[str, float], shots: Sequence[Shot]) -> list[str]:
    """A warning for each model, by name, whose PSNR is hardly above that of one colour each."""
    plain = _plain(shots)
    return [
        f"{name} hardly shows these pictures ({figure:.1f} dB PSNR, and one colour each "
        f"{plain:.1f} dB): it may be of something else, or in another world frame, and its other "
        "figures mean little"
        for name, figure in figures.items()
        if figure < plain + OTHER_SCENE
    ]
