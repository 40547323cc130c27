"""What a frame leaves in memory: its outputs while somebody holds them, and nothing else."""

import gc
import weakref
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import replace

import pytest
import scenes
from gpu.holding import Holding

from fragprune_plugins.engines.cuda import engine as cuda
from fragprune_plugins.engines.cuda.engine import CudaEngine
from fragprune_plugins.workbench.doctor.emulated import EmulatedDevice


@contextmanager
def no_collector() -> Iterator[None]:
    """What only the collector would find counts as held: a GPU does not wait for it."""
    gc.collect()
    gc.disable()
    try:
        yield
    finally:
        gc.enable()


@pytest.fixture
def drawings(monkeypatch: pytest.MonkeyPatch) -> list[weakref.ref]:
    """One for each frame, in order."""
    seen: list[weakref.ref] = []

    class Watched(cuda.Drawing):
        def __init__(self, *given) -> None:
            super().__init__(*given)
            seen.append(weakref.ref(self))

    monkeypatch.setattr(cuda, "Drawing", Watched)
    return seen


def step(engine: CudaEngine, counts: bool = False, backward: bool = True) -> None:
    made, _ = scenes.leaves(scenes.random_scene(0, features=3))
    made = replace(made, counts=True) if counts else made
    out = engine.rasterize(made, scenes.random_thresholds(0, 60).requires_grad_())
    if backward:
        (out.image.sum() + out.features.sum() + out.fragments_per_pixel).backward()


@pytest.mark.parametrize("counts", [False, True])
@pytest.mark.parametrize("backward", [False, True])
def test_a_frame_is_gone_once_its_outputs_are(
    engine: CudaEngine, drawings: list[weakref.ref], counts: bool, backward: bool
) -> None:
    with no_collector():
        for _ in range(3):
            step(engine, counts, backward)
        assert [each() for each in drawings] == [None] * 3


@pytest.mark.parametrize("deterministic", [False, True])
def test_ten_steps_hold_no_more_than_one(device: EmulatedDevice, deterministic: bool) -> None:
    engine = CudaEngine(device, deterministic=deterministic)
    with no_collector(), Holding() as memory:
        step(engine)
        after_one = memory.held
        for _ in range(9):
            step(engine)
        assert memory.held == after_one
