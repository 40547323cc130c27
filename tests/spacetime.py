"""Gaussians in space and time, cut by an engine and by the oracle in double precision."""

import torch

from fragprune_plugins.engines.reference import ReferenceEngine
from fragprune_plugins.slicing.cutting import slice_at
from fragprune_plugins.slicing.splats import Moment, Sliced, SpacetimeSplats

NOW = 0.3
KINDS = ("sliced", "still", "apart", "joint")
OUTPUTS = ("means", "cov3d", "opacities", "colors")


def splats(kind: str, count: int, *, degree: int = 3, coefficients: int = 48, seed: int = 0):
    """Random ones in float64; of those with a time, a part is not there NOW."""
    generator = torch.Generator().manual_seed(seed)

    def random(*shape: int) -> torch.Tensor:
        return torch.randn(count, *shape, generator=generator, dtype=torch.float64)

    unit = torch.nn.functional.normalize
    axes = random(3, 3)
    cov3d = (axes @ axes.mT)[:, [0, 0, 0, 1, 1, 2], [0, 1, 2, 1, 2, 2]]
    given = {
        "means": random(3),
        "opacities": torch.sigmoid(random()),
        "times": NOW + 0.5 * random(),
        "sh": 0.3 * random(coefficients, 3),
        "sh_degree": degree,
        "cov3d": cov3d,
        "scales": 0.3 * torch.exp(0.5 * random(3)),
        "scales_t": 0.2 * torch.exp(0.3 * random()),
        "rotations": unit(random(4), dim=-1),
        "rotations_r": unit(random(4), dim=-1),
    }
    shapes = ["scales", "rotations", "scales_t", "rotations_r"]
    used = {"sliced": ["cov3d"], "still": shapes[:2], "apart": shapes[:3], "joint": shapes}[kind]
    left_out = {"cov3d", *shapes} - set(used)
    return SpacetimeSplats(**{k: v for k, v in given.items() if k not in left_out})


def moment(orders: int | None = 2, **options) -> Moment:
    """NOW, seen from beside the Gaussians."""
    campos = torch.tensor([0.2, -0.4, 5.0], dtype=torch.float64)
    return Moment(NOW, campos, 1.3, orders, **options)


def leaves(given: SpacetimeSplats, dtype: torch.dtype) -> SpacetimeSplats:
    """A copy whose tensors want gradients."""
    tensors = {
        name: value.detach().to(dtype).requires_grad_() if torch.is_tensor(value) else value
        for name, value in vars(given).items()
    }
    return SpacetimeSplats(**tensors)


def gradients(given: SpacetimeSplats, result: Sliced, outputs=OUTPUTS) -> dict[str, torch.Tensor]:
    """Of a weighted sum of outputs, by all that wants one; zeros where nothing is felt."""
    total = torch.zeros((), dtype=torch.float64)
    for name in outputs:
        value = getattr(result, name)
        weights = torch.randn(
            value.shape,
            generator=torch.Generator().manual_seed(OUTPUTS.index(name)),
            dtype=torch.float64,
        )
        total = total + (value.double() * weights).sum()
    tensors = {k: v for k, v in vars(given).items() if torch.is_tensor(v) and v.requires_grad}
    found = torch.autograd.grad(total, list(tensors.values()), allow_unused=True)
    return {
        name: torch.zeros_like(tensor) if grad is None else grad
        for (name, tensor), grad in zip(tensors.items(), found, strict=True)
    }


def cut(engine, given: SpacetimeSplats, when: Moment) -> Sliced:
    """Cut by an engine."""
    return slice_at(given, when, engine=engine)


def agree(engine, given: SpacetimeSplats, when: Moment, *, outputs=OUTPUTS) -> None:
    """Values and gradients are the oracle's, to single precision's rounding.

    A rounding is 6e-8 of the largest term. Some forty lie on the way of a value, more on that of a
    gradient, and they add up like a random walk, to 1e-6 of the largest where it was measured.
    """
    exact, single = leaves(given, torch.float64), leaves(given, torch.float32)
    expected, found = cut(ReferenceEngine(), exact, when), cut(engine, single, when)
    assert torch.equal(found.present, expected.present)
    for name in OUTPUTS:
        torch.testing.assert_close(
            getattr(found, name).double(), getattr(expected, name), rtol=1e-5, atol=2e-6, msg=name
        )
    expected_grads, grads = gradients(exact, expected, outputs), gradients(single, found, outputs)
    for name, grad in grads.items():
        size = expected_grads[name].abs().max().item() if len(grad) else 0.0
        torch.testing.assert_close(
            grad.double(), expected_grads[name], rtol=1e-5, atol=2e-6 * size, msg=name
        )
