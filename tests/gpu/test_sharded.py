"""The kernels, emulated, under Gaussians that are divided among processes."""

from dataclasses import replace

import torch
from finetune import tiny
from finetune.several import learn

from fragprune_plugins import RasterInputs, ShardedEngine, ThresholdStore, part_of
from fragprune_plugins.engines.cuda.engine import CudaEngine

LEARNED = ("xyz", "f_rest", "opacity", "scaling")


def drawn(engine, model, indices):
    """Pictures from some cameras, and the gradients by all of them together."""
    for name in LEARNED:
        getattr(model, name).requires_grad_()
    pictures = []
    for index in indices:
        inputs = RasterInputs(tiny.cameras()[index].view(), model.splats())
        outputs = engine.rasterize(inputs, model.thresholds.values)
        (outputs.image.square().sum() + outputs.fragments_per_pixel).backward()
        pictures.append(outputs.image.detach())
    leaves = [getattr(model, name) for name in LEARNED] + [model.thresholds.logits]
    return pictures, [leaf.grad for leaf in leaves]


def scene(count):
    splat = tiny.random_model(count, degree=3)
    return replace(splat, thresholds=ThresholdStore.from_falloff(torch.linspace(0.02, 0.4, count)))


def test_the_kernels_draw_shards_as_they_draw_the_whole(device):
    engine = CudaEngine(device, deterministic=True)
    pictures, gradients = drawn(engine, scene(40), (0, 1))

    def work(ranks):
        part = part_of(scene(40), ranks, "cpu")
        return drawn(ShardedEngine(engine, ranks), part, [ranks.rank])

    parts = learn(2, work)
    for (found,), expected in zip((part[0] for part in parts), pictures, strict=True):
        assert torch.allclose(found, expected, atol=1e-6)  # colours: compiled in two places
    for expected, *found in zip(gradients, *(part[1] for part in parts), strict=True):
        scale = float(expected.abs().max())
        assert torch.allclose(torch.cat(found), expected, atol=2e-6 * scale, rtol=1e-5)
