"""On a GPU, against the reference engine on the same GPU in float64. Needs one: -m gpu."""

from dataclasses import replace

import pytest
import scenes
import torch
from gpu.test_against_oracle import KINDS
from native.test_dialects import dialect

from fragprune_plugins.engines.cuda.comparison import compare
from fragprune_plugins.engines.cuda.driver import Driver
from fragprune_plugins.engines.cuda.engine import CudaEngine
from fragprune_plugins.engines.reference import ReferenceEngine
from fragprune_plugins.types import RasterInputs

pytestmark = pytest.mark.gpu


@pytest.fixture(scope="module")
def engine() -> CudaEngine:
    return CudaEngine(deterministic=True)


def gradients(engine, inputs: RasterInputs, thresholds: torch.Tensor, same: torch.Tensor) -> dict:
    made, leaves = scenes.leaves(inputs)
    leaves["thresholds"] = thresholds = thresholds.clone().requires_grad_()
    out = engine.rasterize(made, thresholds)
    picture = torch.cat([out.image, out.invdepth, out.alpha])
    weights = torch.rand(picture.shape, generator=torch.Generator().manual_seed(0)) - 0.3
    loss = (picture * (weights.cuda() * same).to(picture.dtype)).sum() + out.fragments_per_pixel
    loss.backward()
    return {name: leaf.grad for name, leaf in leaves.items() if leaf.grad is not None}


@pytest.mark.parametrize("kind", KINDS)
def test_images_and_gradients_equal_the_oracle(engine: CudaEngine, kind: str) -> None:
    inputs = replace(scenes.cast(dialect(1, **KINDS[kind]), torch.float32, "cuda"), counts=True)
    thresholds = scenes.random_thresholds(1, 60, device="cuda")
    wide = scenes.cast(inputs, torch.float64, "cuda")
    truth = ReferenceEngine().rasterize(wide, thresholds.double())
    ours = engine.rasterize(inputs, thresholds)
    same = truth.fragments == ours.fragments
    assert (~same).sum() <= 1 + same.numel() // 500
    assert (truth.image - ours.image)[:, same].abs().max() < 2e-5
    expected = gradients(ReferenceEngine(), wide, thresholds.double(), same)
    found = gradients(engine, inputs, thresholds, same)
    for name, grad in expected.items():
        scale = grad.abs().max().item() + 1e-3
        assert (found[name] - grad).abs().max().item() < 3e-4 * scale, name


def test_the_check_that_comes_before_use_is_passed() -> None:
    assert compare(Driver(), torch.device("cuda:0")) == []


def test_runs_agree_to_the_bit_at_size(engine: CudaEngine) -> None:
    inputs = scenes.random_scene(0, 200_000, 1300, 900, scale_modifier=0.3, device="cuda")
    thresholds = scenes.random_thresholds(0, 200_000, device="cuda")
    inputs = replace(inputs, scores=True, counts=True)
    found = []
    for _ in range(3):
        made, leaves = scenes.leaves(inputs)
        out = engine.rasterize(made, thresholds)
        out.image.square().sum().backward()
        found.append((out.image, out.winners, leaves["means"].grad, leaves["sh"].grad))
    for other in found[1:]:
        for a, b in zip(found[0], other, strict=True):
            assert torch.equal(a, b)
