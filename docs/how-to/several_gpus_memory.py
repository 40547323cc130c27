"""Peak memory of processes that divide the Gaussians of a corridor, and how long a step takes.

torchrun --nproc_per_node N several_gpus_memory.py GAUSSIANS opacity|appearance|all

Four steps of four views, from sixteen places along the corridor, on processors.
"""

from __future__ import annotations

import sys
import time
from dataclasses import dataclass
from pathlib import Path

import torch
from torch import Tensor

import fragprune_plugins as fp
from fragprune_plugins.learning.goals import Pressure
from fragprune_plugins.workbench.scenes.dataset import Dataset, Shot

LENGTH, STEPS, VIEWS = 200.0, 4, 4


@dataclass(frozen=True, eq=False)
class Grey(Shot):
    """A view whose photograph is grey."""

    @property
    def image(self) -> Tensor:
        """(3, H, W) RGB."""
        return torch.full((3, self.view.height, self.view.width), 0.5)


def part(count: int, rank: int, size: int) -> fp.Model:
    """One process' piece of the corridor, 4 x 3 units wide."""
    stream = torch.Generator().manual_seed(rank)
    place = torch.rand(count, 3, generator=stream) - torch.tensor([0.5, 0.5, -float(rank)])
    shape = 0.3 * torch.randn(count, 3, generator=stream) - 4
    return fp.Model(
        xyz=place * torch.tensor([4.0, 3.0, LENGTH / size]),
        f_dc=torch.randn(count, 1, 3, generator=stream),
        f_rest=0.1 * torch.randn(count, 15, 3, generator=stream),
        opacity=torch.randn(count, 1, generator=stream),
        scaling=shape,
        rotation=torch.randn(count, 4, generator=stream),
    )


def shot(z: float) -> Grey:
    """A view along the corridor from one place in it."""
    view = fp.look_at((0, 0, z), (0, 0, z + 1), width=480, height=320, fov_y=60)
    return Grey(f"from {z:g}", view)


def peak() -> int:
    """Most memory that this process has had, in KB."""
    lines = Path("/proc/self/status").read_text().splitlines()
    return next(int(line.split()[1]) for line in lines if line.startswith("VmHWM"))


if len(sys.argv) != 3 or not sys.argv[1].isdecimal():
    sys.exit(__doc__)
count, train = int(sys.argv[1]), sys.argv[2]
shots = [shot(LENGTH * index / 16) for index in range(16)]
before = peak()
with fp.joined(torch.device("cpu")) as ranks:
    torch.set_num_threads(1)
    engine = fp.ShardedEngine(fp.engine_for("cpu"), ranks)
    splat = part(count // ranks.size, ranks.rank, ranks.size)
    settings = fp.Settings(STEPS, train=train, views_per_step=VIEWS, goal=Pressure(1e-4))
    started = time.perf_counter()
    fp.finetune(splat, Dataset(shots, shots[:1]), settings, engine=engine, ranks=ranks)
    seconds = (time.perf_counter() - started) / STEPS
    told = ranks.gather(((peak() - before) // 1024, engine.sent))
    if ranks.first:
        print(f"{train}, processes: {ranks.size}, MB of each: {[mb for mb, _ in told]},", end=" ")
        print(f"{seconds:.1f} s a step, {sum(sent for _, sent in told):,} Gaussians sent")
