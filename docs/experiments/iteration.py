"""Where the time of a `finetune` step goes, by stage; and what the loss alone takes.

python iteration.py [--size 640x480 ...] [--gaussians N] [--steps 30] [--threads 2] [--processor]
                    [--plain]
python iteration.py --loss [--size 640x480 ...]

Trains the bench scene of SH degree 3, whole and with every Gaussian cut at a falloff, on pictures
of itself in other colours, and prints a table: medians over steps in milliseconds of the wall's
clock, or of the processor's, which other programs disturb less; then, for each step, processor
time of the user and of the system, and page faults. With --plain: torch's loss and loop of Adam,
and memory that goes back to the kernel.

With --loss: value and gradient by torch and by each build, processor time of one thread, the least
of 9.
"""

from __future__ import annotations

import os
import resource
import statistics
import sys
import tempfile
import time
from argparse import ArgumentParser
from collections import defaultdict
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager, nullcontext
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any
from unittest import mock

import numpy as np
import PIL.Image
import torch

from fragprune_plugins.engines import create_engine
from fragprune_plugins.engines.cpu import binding
from fragprune_plugins.engines.cpu import engine as cpu
from fragprune_plugins.engines.cpu.memory import keep_freed_memory
from fragprune_plugins.engines.losses import compiled_loss
from fragprune_plugins.learning.goals import Control, Pressure
from fragprune_plugins.learning.schedule import Schedule, Settings
from fragprune_plugins.learning.thresholds import ThresholdStore
from fragprune_plugins.types import RasterInputs
from fragprune_plugins.workbench.bench.scene import make_scene, make_view
from fragprune_plugins.workbench.bench.timing import describe_machine
from fragprune_plugins.workbench.finetune import loop, losses
from fragprune_plugins.workbench.finetune.api import finetune
from fragprune_plugins.workbench.scenes.dataset import Dataset, Photograph

FALLOFF = 0.06
VIEWS = 4
STAGES = ("photograph", "forward", "loss", "backward", "rest of autograd", "Adam", "other")
SKIPPED = 5  # first steps: every view is drawn twice at its first visit


class Clock:
    """Adds up the time of named calls within a step; a call inside another counts for itself."""

    def __init__(self, now: Callable[[], float]) -> None:
        self.now = now
        self.steps: list[dict[str, float]] = []
        self.running: list[str] = []
        self.since = 0.0

    def switch(self) -> None:
        """Book the time since the last call on what runs."""
        now = self.now()
        if self.running and self.steps:
            self.steps[-1][self.running[-1]] += now - self.since
        self.since = now

    def timed(self, name: str, work: Callable[..., Any]) -> Callable[..., Any]:
        """The same call, timed."""

        def call(*args: Any, **kwargs: Any) -> Any:
            self.switch()
            self.running.append(name)
            try:
                return work(*args, **kwargs)
            finally:
                self.switch()
                self.running.pop()

        return call

    def step(self, work: Callable[..., Any]) -> Callable[..., Any]:
        """The same call, as a step."""
        timed = self.timed("other", work)

        def call(*args: Any, **kwargs: Any) -> Any:
            self.steps.append(defaultdict(float))
            before = resource.getrusage(resource.RUSAGE_SELF)
            timed(*args, **kwargs)
            after = resource.getrusage(resource.RUSAGE_SELF)
            self.steps[-1] |= {
                "user": after.ru_utime - before.ru_utime,
                "system": after.ru_stime - before.ru_stime,
                "faults": (after.ru_minflt - before.ru_minflt) / 1e3,
            }

        return call


@contextmanager
def watched(now: Callable[[], float]) -> Iterator[Clock]:
    """Inside, steps of ``finetune`` are timed by stage."""
    clock = Clock(now)
    image = Photograph.image.fget
    assert image is not None
    with ExitStack() as stack:
        for owner, attribute, name in (
            (cpu.CpuEngine, "rasterize", "forward"),
            (cpu._Drawing, "undraw", "backward"),
            (loop, "photometric_loss", "loss"),
            (torch.autograd, "backward", "rest of autograd"),
            (torch.optim.Adam, "step", "Adam"),
        ):
            timed = clock.timed(name, getattr(owner, attribute))
            stack.enter_context(mock.patch.object(owner, attribute, timed))
        seen = property(clock.timed("photograph", image))
        stack.enter_context(mock.patch.object(Photograph, "image", seen))
        learn = clock.step(loop.Training._step)
        stack.enter_context(mock.patch.object(loop.Training, "_step", learn))
        yield clock


def photographs(folder: Path, gaussians: int, width: int, height: int) -> list[Photograph]:
    """Pictures of the scene with other colours."""
    scene = make_scene(gaussians)
    scene = replace(scene, f_dc=scene.f_dc + 0.1 * torch.randn(scene.f_dc.shape))
    found, view = [], make_view(width, height)
    with torch.no_grad():
        picture = create_engine("cpu").rasterize(RasterInputs(view, scene.splats()), None).image
    pixels = (255 * picture.clamp(0, 1)).round().byte().permute(1, 2, 0).numpy()
    for i in range(VIEWS):
        path = folder / f"{i}.png"
        PIL.Image.fromarray(np.ascontiguousarray(pixels)).save(path)
        found.append(Photograph(f"{i}", view, path))
    return found


def profile(
    gaussians: int, size: str, steps: int, now: Callable[[], float]
) -> dict[str, dict[str, float]]:
    """Medians in ms, for a whole and for a cut model."""
    table = {}
    with tempfile.TemporaryDirectory() as folder:
        torch.manual_seed(0)
        shots = photographs(Path(folder), gaussians, *map(int, size.split("x")))
        data = Dataset(shots, shots)
        for kind in ("whole", "cut"):
            cut = kind == "cut"
            settings = Settings(iterations=steps + SKIPPED, goal=Pressure() if cut else Control())
            store = ThresholdStore.from_falloff(torch.full((gaussians,), FALLOFF)) if cut else None
            scene = replace(make_scene(gaussians), thresholds=store)
            plan = Schedule(settings, warmup=0)
            with watched(now) as clock:
                finetune(scene, data, settings, schedule=plan, engine="cpu")
            kept = clock.steps[SKIPPED:]
            names = (*STAGES, "user", "system", "faults")
            row = {n: 1e3 * statistics.median(step.get(n, 0.0) for step in kept) for n in names}
            sums = [1e3 * sum(step.get(name, 0.0) for name in STAGES) for step in kept]
            table[f"{size} {kind}"] = row | {"step": statistics.median(sums), "least": min(sums)}
    return table


def torch_loss(image: torch.Tensor, target: torch.Tensor) -> torch.Tensor:
    """The loss as torch computes it."""
    similar = losses.ssim_map(image, target).mean()
    weight = losses.SSIM_WEIGHT
    return (1 - weight) * (image - target).abs().mean() + weight * (1 - similar)


def time_losses(size: str) -> dict[str, float]:
    """Value and gradient in ms of one thread's time, least of 9."""
    width, height = map(int, size.split("x"))
    image, target = (torch.rand(3, height, width) for _ in range(2))
    image.requires_grad_()
    builds = {name: binding.open_build(name) for name in reversed(binding.usable_builds())}
    codes = {"torch": torch_loss} | {
        name: partial(compiled_loss, ssim_weight=losses.SSIM_WEIGHT, library=library)
        for name, library in builds.items()
    }
    found = {}
    for name, code in codes.items():
        rounds = []
        for _ in range(9):
            since = time.process_time()
            torch.autograd.grad(code(image, target), image)
            rounds.append(1e3 * (time.process_time() - since))
        found[name] = min(rounds)
    return found


def show(columns: dict[str, dict[str, float]]) -> None:
    """Print a table whose columns are given."""
    rows = list(next(iter(columns.values())))
    say = sys.stdout.write
    say("| | " + " | ".join(columns) + " |\n" + "|---" * (len(columns) + 1) + "|\n")
    for name in rows:
        cells = (f"{column[name]:.{0 if name == 'faults' else 1}f}" for column in columns.values())
        say(f"| {name} | " + " | ".join(cells) + " |\n")


def main() -> None:
    """Measure and print."""
    parser = ArgumentParser(description=__doc__.split("\n")[0] if __doc__ else "")
    parser.add_argument("--size", action="append")
    parser.add_argument("--gaussians", type=int, default=100_000)
    parser.add_argument("--steps", type=int, default=30)
    parser.add_argument("--threads", type=int, default=2)
    parser.add_argument("--processor", action="store_true")
    parser.add_argument("--plain", action="store_true")
    parser.add_argument("--loss", action="store_true")
    args = parser.parse_args()
    sizes = args.size or ["320x240", "640x480", "1280x960"]
    torch.set_num_threads(1 if args.loss else args.threads)
    if args.plain:
        loop.photometric_loss, loop.stepping_fused = torch_loss, nullcontext
    else:
        keep_freed_memory()
    columns: dict[str, dict[str, float]] = {}
    for size in sizes:
        if args.loss:
            columns[size] = time_losses(size)
        else:
            now = time.process_time if args.processor else time.perf_counter
            columns |= profile(args.gaussians, size, args.steps, now)
    load = os.getloadavg()[0]
    sys.stdout.write(f"{describe_machine(torch.device('cpu'))}, load {load:.1f}\n\n")
    show(columns)


if __name__ == "__main__":
    main()
