"""Long fine-tunings: memory stays flat, and thresholds that have settled do not drift."""

import gc
from pathlib import Path

import pytest
import torch
from finetune import tiny

from fragprune_plugins import Pressure, Schedule, Settings, StepPlan, finetune
from fragprune_plugins.learning.events import StepStats
from fragprune_plugins.testing.fresh import fresh

PAGE = 4096
A_POINT = 600  # bytes of one point of the curves, which are kept on purpose


class Settled(Schedule):
    """Rates as they are at the end of a run, from the first half on."""

    def at(self, step: int) -> StepPlan:
        return super().at(min(self.settings.iterations, 2 * step))


def resident() -> int:
    return int(Path("/proc/self/statm").read_text().split()[1]) * PAGE


def tensors() -> int:
    gc.collect()
    return sum(issubclass(type(each), torch.Tensor) for each in gc.get_objects())


def learn_for(steps: int, folder: Path) -> tuple[list[StepStats], list[tuple[int, int]], object]:
    """Fine-tune; the curves, (bytes, tensors) at the half and at the end, and the result."""
    truth = tiny.random_model()
    looks: list[tuple[int, int]] = []

    class Looking(Settled):
        def at(self, step: int) -> StepPlan:
            if step in (steps // 2, steps):
                looks.append((resident(), tensors()))
            return super().at(step)

    settings = Settings(iterations=steps, train="opacity", goal=Pressure(1e-3))
    model, dataset = tiny.perturbed(truth), tiny.dataset_in_memory(folder, truth)
    result = finetune(model, dataset, settings, schedule=Looking(settings))
    return list(result.curves), looks, result


def require_calm(steps: int, folder: Path) -> None:
    curves, (half, end), result = learn_for(steps, folder)
    assert end[1] <= half[1] + 2  # tensors alive
    assert end[0] - half[0] < 4_000_000 + A_POINT * steps // 2  # bytes
    assert all(each.isfinite().all() for each in result.model.thresholds.numbers.values())
    third, last = (
        sum(point.fragments_per_pixel for point in part) / len(part)
        for part in (curves[steps // 2 : 3 * steps // 4], curves[3 * steps // 4 :])
    )
    assert last == pytest.approx(third, rel=0.02)
    medians = [point.threshold_median for point in curves[3 * steps // 4 :]]
    assert max(medians) == pytest.approx(min(medians), rel=0.1)


@pytest.mark.skipif(not Path("/proc/self/statm").exists(), reason="reads /proc")
def test_memory_is_flat_and_thresholds_do_not_drift(tmp_path):
    fresh(require_calm, 240, tmp_path)  # where no other test has left holes in the heap


@pytest.mark.slow
@pytest.mark.timeout(7200)
@pytest.mark.skipif(not Path("/proc/self/statm").exists(), reason="reads /proc")
def test_nor_over_fifty_thousand_steps(tmp_path):
    require_calm(50_000, tmp_path)
