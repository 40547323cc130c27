"""Models of one scene beside each other: held-out and training views, elsewhere, and frames.

python full_size.py --data SCENE --first MODEL.ply [--resolution 1] [--sizes 1 2 4] [--rounds 3]
                    MODEL.ply ...

MODEL.ply of --first is the model as it came. Prints a row for each other one: PSNR on training and
held-out views and SSIM on these, fragments per pixel; then how far its pictures are from those of
the first model, in dB, and the worst one, from cameras beside those of the photographs: on the far
side of each, up to 0.7 of the way to a neighbour. Then frames of the held-out views at several
sizes: least processor times of one thread over rounds in turns, summed, against the first of the
other models.
"""

from __future__ import annotations

import random
import statistics
import sys
import time
from argparse import ArgumentParser
from collections.abc import Sequence
from pathlib import Path

import torch
from torch import Tensor

from fragprune_plugins.engines import Engine, create_engine
from fragprune_plugins.files.model import Model
from fragprune_plugins.hosts.photographs import Photographs, Resolution
from fragprune_plugins.types import RasterInputs, View
from fragprune_plugins.workbench.figures.evaluate import enlarged
from fragprune_plugins.workbench.figures.metrics import psnr, ssim
from fragprune_plugins.workbench.models.model import load
from fragprune_plugins.workbench.scenes.dataset import Shot, load_photographs
from fragprune_plugins.workbench.scenes.generated import between, interpolate
from fragprune_plugins.workbench.scenes.output import arguments

FAR = (-0.7, -0.3)  # of the way to a neighbour, on the other side
EVERY = 8  # of these cameras is used


def picture(engine: Engine, model: Model, view: View) -> tuple[Tensor, float]:
    """What a model shows (3, H, W), in [0, 1], and its fragments per pixel."""
    inputs = RasterInputs(view, model.splats(), planes=(), **model.rules)
    drawn = engine.rasterize(inputs, model.falloff)
    return drawn.image.clamp(0, 1), float(drawn.fragments_per_pixel)


def elsewhere(shots: Sequence[Shot]) -> list[View]:
    """Cameras beside those of photographs, away from their neighbours."""
    views, stream = {shot.name: shot.view for shot in shots}, random.Random(78)
    pairs = [name.split("~") for name, _ in between(list(views.items()))]
    return [interpolate(views[a], views[b], stream.uniform(*FAR)) for a, b in pairs[::EVERY]]


def frames(
    engine: Engine, models: dict[str, Model], views: Sequence[View], rounds: int
) -> dict[str, float]:
    """Seconds of all views by model: the least of each, in turns."""
    ready = {name: (each.splats(), each.falloff, each.rules) for name, each in models.items()}
    least = {name: [float("inf")] * len(views) for name in models}
    for turn in range(rounds):
        for i, view in enumerate(views):
            for name in list(ready)[:: -1 if turn % 2 else 1]:
                splats, falloff, rules = ready[name]
                inputs = RasterInputs(view, splats, planes=(), **rules)
                since = time.process_time()
                engine.rasterize(inputs, falloff)
                least[name][i] = min(least[name][i], time.process_time() - since)
    return {name: sum(each) for name, each in least.items()}


@torch.no_grad()
def main() -> None:
    """Measure and print."""
    parser = ArgumentParser(description=__doc__.split("\n")[0] if __doc__ else "")
    parser.add_argument("--data", type=Path, required=True)
    parser.add_argument("--first", type=Path, required=True)
    parser.add_argument("--resolution", type=int, default=1, help="divides the photographs' sides")
    parser.add_argument("--sizes", type=int, nargs="+", default=[1, 2, 4])
    parser.add_argument("--rounds", type=int, default=3)
    parser.add_argument("models", type=Path, nargs="+")
    args = parser.parse_args()
    torch.set_num_threads(1)
    engine, say = create_engine("cpu"), sys.stdout.write
    size, told = Resolution(args.resolution), arguments(args.first)
    white = told is not None and told.white_background
    dataset = load_photographs(Photographs(args.data, size, white))
    first, models = load(args.first), {str(path): load(path) for path in args.models}
    beside = elsewhere(dataset.train)
    shown = [picture(engine, first, view)[0] for view in beside]
    say("| model | training, dB | held out, dB | SSIM | fragments | elsewhere, dB | worst |\n")
    say("|---|---|---|---|---|---|---|\n")
    for name, model in {"first": first, **models}.items():
        trained = [psnr(picture(engine, model, s.view)[0], s.image) for s in dataset.train]
        held = [(*picture(engine, model, s.view), s.image) for s in dataset.test]
        figures = [(psnr(own, right), ssim(own, right), drawn) for own, drawn, right in held]
        means = [statistics.fmean(each) for each in zip(*figures, strict=True)]
        away = [psnr(picture(engine, model, v)[0], s) for v, s in zip(beside, shown, strict=True)]
        say(
            f"| {name} | {statistics.fmean(trained):.2f} | {means[0]:.2f} | {means[1]:.4f} | "
            f"{means[2]:.1f} | {statistics.fmean(away):.1f} | {min(away):.1f} |\n"
        )
    views = [shot.view for shot in dataset.test]
    for size in args.sizes:
        large = [enlarged(view, size) for view in views]
        taken = frames(engine, models, large, args.rounds)
        base = next(iter(taken.values()))
        ratios = (f"{n} {1e3 * s / len(views):.1f} ms, {base / s:.2f}x" for n, s in taken.items())
        say(f"{size}x: {'; '.join(ratios)}\n")


if __name__ == "__main__":
    main()
