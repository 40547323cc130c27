"""Fine-tuning and measuring with the cuda engine, emulated: the same course as on the CPU."""

import pytest
import torch
from finetune import tiny

from fragprune_plugins import Pressure, Settings, finetune
from fragprune_plugins.engines import create_engine
from fragprune_plugins.workbench.figures.evaluate import Candidate, measure_all


def test_learned_and_measured_as_on_the_cpu(engine, tmp_path):
    truth = tiny.random_model()
    dataset = tiny.dataset_in_memory(tmp_path, truth)
    settings = Settings(iterations=3, goal=Pressure(1e-3))
    courses = []
    for each in (engine, create_engine("cpu")):
        result = finetune(tiny.perturbed(truth), dataset, settings, engine=each)
        candidate = Candidate(result.model)
        (report,) = measure_all([candidate], dataset.test[:1], engine=each, repeats=1)
        courses.append((result, report))
    (ours, seen), (cpu, expected) = courses
    torch.testing.assert_close(
        ours.model.thresholds.logits, cpu.model.thresholds.logits, atol=1e-3, rtol=1e-3
    )
    torch.testing.assert_close(ours.model.opacity, cpu.model.opacity, atol=1e-3, rtol=1e-3)
    assert (seen["engine"], expected["engine"]) == ("cuda", "cpu")
    for figure in ("psnr", "fragments_per_pixel"):
        assert seen[figure] == pytest.approx(expected[figure], rel=1e-3)
