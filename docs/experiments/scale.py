"""What grows with the number of Gaussians: time and peak memory, each in a process of its own.

python scale.py --folder DIR [--millions 1 3 6] [--size 1920x1080 ...] [--threads 2]

Makes bench scenes of SH degree 3 whose Gaussians are the smaller the more they are, so that the
fragments per pixel stay, as files in DIR. Prints a row for each: loading, saving, a frame, a step
of `finetune` (all parameters, every Gaussian cut at a falloff of 0.06), `audit` and `view --out`.
Seconds are the wall clock's, so let no other program run. A command's are of its whole process.
"""

from __future__ import annotations

import json
import math
import statistics
import subprocess
import sys
import time
from argparse import ArgumentParser
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import PIL.Image
import torch

from fragprune_plugins.engines import create_engine
from fragprune_plugins.engines.cpu.memory import keep_freed_memory
from fragprune_plugins.files.ply import read_ply
from fragprune_plugins.learning.schedule import Schedule, Settings
from fragprune_plugins.learning.thresholds import ThresholdStore
from fragprune_plugins.types import RasterInputs
from fragprune_plugins.workbench.bench.scene import make_scene, make_view
from fragprune_plugins.workbench.finetune import loop
from fragprune_plugins.workbench.finetune.api import finetune
from fragprune_plugins.workbench.models.formats.ply import write_ply
from fragprune_plugins.workbench.scenes.dataset import Dataset, Photograph

FALLOFF = 0.06
STEPS = 7
FIRST = 3  # steps that also draw the view without thresholds, or allocate


def make(path: Path, count: int) -> None:
    """Write a scene, unless it is there."""
    if not path.exists():
        scene = make_scene(count)
        scene = replace(scene, scaling=scene.scaling + 0.5 * math.log(100_000 / count))
        write_ply(path, scene)


def loading(path: Path, size: str) -> list[float]:
    """Read the file."""
    return [seconds(lambda: read_ply(path))]


def saving(path: Path, size: str) -> list[float]:
    """Write it again."""
    model = read_ply(path)
    return [seconds(lambda: write_ply(path.with_suffix(".again.ply"), model))]


def frame(path: Path, size: str) -> list[float]:
    """Draw a frame, five times."""
    engine, model = create_engine("cpu"), read_ply(path)
    inputs = RasterInputs(make_view(*map(int, size.split("x"))), model.splats(), planes=())
    with torch.no_grad():
        return [seconds(lambda: engine.rasterize(inputs, None)) for _ in range(5)]


def step(path: Path, size: str) -> list[float]:
    """Steps of ``finetune`` after the first."""
    keep_freed_memory()
    view, model = make_view(*map(int, size.split("x"))), read_ply(path)
    pixels = np.random.default_rng(0).integers(0, 256, (view.height, view.width, 3), dtype=np.uint8)
    photograph = path.with_suffix(".png")
    PIL.Image.fromarray(pixels).save(photograph)
    shots = [Photograph("a", view, photograph)]
    model = replace(
        model, thresholds=ThresholdStore.from_falloff(torch.full((len(model),), FALLOFF))
    )
    settings, found = Settings(iterations=STEPS), []
    taken = loop.Training._step

    def timed(*args: object) -> None:
        found.append(seconds(lambda: taken(*args)))  # type: ignore[arg-type]

    loop.Training._step = timed  # type: ignore[method-assign]
    finetune(model, Dataset(shots, []), settings, schedule=Schedule(settings, 0), engine="cpu")
    return found[FIRST:]


STAGES: dict[str, Callable[[Path, str], list[float]]] = {
    each.__name__: each for each in (loading, saving, frame, step)
}
COMMANDS = {"audit": ("--json",), "view": ("--out", "{folder}/view.html")}


def seconds(work: Callable[[], object]) -> float:
    """Time of a call."""
    since = time.perf_counter()
    work()
    return time.perf_counter() - since


def measured(words: list[str]) -> tuple[list[float], float]:
    """Seconds that a process prints, or took, and its peak memory in GB."""
    code = (
        "import json, resource, subprocess, sys, time\n"
        "since = time.perf_counter()\n"
        "done = subprocess.run(sys.argv[1:], stdout=subprocess.PIPE, check=True, text=True)\n"
        "whole = time.perf_counter() - since\n"
        "peak = resource.getrusage(resource.RUSAGE_CHILDREN).ru_maxrss\n"
        "print(json.dumps([done.stdout, whole, peak]))"
    )
    told = subprocess.run(
        [sys.executable, "-c", code, *words], stdout=subprocess.PIPE, check=True, text=True
    )
    printed, whole, peak = json.loads(told.stdout)
    own = words[1].endswith("scale.py")
    return (json.loads(printed) if own else [whole]), peak / 2**20


def main() -> None:
    """Measure and print."""
    parser = ArgumentParser(description=__doc__.split("\n")[0] if __doc__ else "")
    parser.add_argument("--folder", type=Path, required=True)
    parser.add_argument("--millions", type=float, nargs="+", default=[1, 3, 6])
    parser.add_argument("--size", nargs="+", default=["1920x1080"])
    parser.add_argument("--threads", type=int, default=2)
    parser.add_argument("--only", nargs="+", default=[*STAGES, *COMMANDS])
    parser.add_argument("--stage", choices=STAGES, help="what a process of its own does")
    args = parser.parse_args()
    torch.set_num_threads(args.threads)
    say = sys.stdout.write
    if args.stage:
        path = args.folder / f"{args.millions[0]:g}.ply"
        say(json.dumps(STAGES[args.stage](path, args.size[0])))
        return
    say("| Gaussians, millions | size | what | seconds | peak, GB |\n" + "|---" * 5 + "|\n")
    for millions in args.millions:
        path = args.folder / f"{millions:g}.ply"
        make(path, round(millions * 1e6))
        for name in args.only:
            for size in args.size if name in ("frame", "step") else args.size[:1]:
                if name in STAGES:
                    words = [__file__, "--folder", str(args.folder), "--millions", f"{millions:g}"]
                    words = [sys.executable, *words, "--size", size, "--stage", name]
                    words += ["--threads", str(args.threads)]
                else:
                    more = [word.format(folder=args.folder) for word in COMMANDS[name]]
                    words = [sys.executable, "-m", "fragprune_plugins", name, str(path), *more]
                times, peak = measured(words)
                spread = f"{statistics.median(times):.2f} ({min(times):.2f} to {max(times):.2f})"
                say(f"| {millions:g} | {size} | {name} | {spread} | {peak:.2f} |\n")
                sys.stdout.flush()


if __name__ == "__main__":
    main()
