"""On a GPU, against the oracle in float64. Needs one: -m gpu."""

import pytest
import scenes
import torch
from elsewhere import moved
from gpu.test_against_oracle import KINDS
from native import test_against_oracle as native

from fragprune_plugins.engines.cuda.comparison import compare
from fragprune_plugins.engines.cuda.driver import Driver
from fragprune_plugins.engines.cuda.engine import CudaEngine
from fragprune_plugins.types import RasterInputs, RasterOutputs

pytestmark = pytest.mark.gpu


class OnGpu:
    """Draws on the GPU what lies on the CPU, and brings it back."""

    def rasterize(self, inputs: RasterInputs, thresholds: torch.Tensor) -> RasterOutputs:
        engine = CudaEngine(deterministic=True)
        return moved(engine.rasterize(moved(inputs, "cuda"), moved(thresholds, "cuda")), "cpu")


@pytest.mark.parametrize("kind", KINDS)
def test_images_and_gradients_equal_the_oracle(kind):
    inputs = scenes.random_scene(1, **native.KINDS[kind])
    native.expect_oracle(OnGpu(), inputs, scenes.random_thresholds(1, 60))


def test_the_check_that_comes_before_use_is_passed():
    assert compare(Driver(), torch.device("cuda:0")) == []


def test_runs_agree_to_the_bit_at_size():
    engine = CudaEngine(deterministic=True)
    asked = {"scores": True, "counts": True, "device": "cuda"}
    inputs = scenes.random_scene(0, 200_000, 1300, 900, scale_modifier=0.3, **asked)
    thresholds = scenes.random_thresholds(0, 200_000, device="cuda")
    found = []
    for _ in range(3):
        made, leaves = scenes.leaves(inputs)
        out = engine.rasterize(made, thresholds)
        out.image.square().sum().backward()
        found.append((out.image, out.winners, leaves["means"].grad, leaves["sh"].grad))
    for other in found[1:]:
        for a, b in zip(found[0], other, strict=True):
            assert torch.equal(a, b)
