"""What a frame leaves in memory: its outputs while somebody holds them, and nothing else."""

import gc
from collections.abc import Iterator
from contextlib import contextmanager

import pytest
import scenes
from gpu.holding import Holding

from fragprune_plugins.engines.cuda.engine import CudaEngine


@contextmanager
def no_collector() -> Iterator[None]:
    """What only the collector would find counts as held: a GPU does not wait for it."""
    gc.collect()
    gc.disable()
    try:
        yield
    finally:
        gc.enable()


@pytest.mark.parametrize("backward", [False, True], ids=["drawn", "learned"])
@pytest.mark.parametrize("counts", [False, True], ids=["", "counted"])
@pytest.mark.parametrize("deterministic", [False, True], ids=["", "deterministic"])
def test_ten_steps_hold_no_more_than_one(device, deterministic, counts, backward):
    engine = CudaEngine(device, deterministic=deterministic)

    def step() -> None:
        made, _ = scenes.leaves(scenes.random_scene(0, features=3, counts=counts))
        out = engine.rasterize(made, scenes.random_thresholds(0, 60).requires_grad_())
        if backward:
            (out.image.sum() + out.features.sum() + out.fragments_per_pixel).backward()

    with no_collector(), Holding() as memory:
        step()
        after_one = memory.held
        for _ in range(9):
            step()
        assert memory.held == after_one
