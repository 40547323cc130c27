"""Splats for the tests of formats, and how far apart two are."""

import torch
from hypothesis import strategies as st

from fragprune_plugins.files.model import Model
from reference_renderer.covariance import rotation_matrices


def random_splat(count: int, degree: int, seed: int) -> Model:
    """Values as trainings leave them: positions within 8, SH within 0.8, opacities 0.03 to 0.97."""
    stream = torch.Generator().manual_seed(seed)

    def uniform(low: float, high: float, *shape: int) -> torch.Tensor:
        return low + (high - low) * torch.rand(*shape, generator=stream)

    return Model(
        xyz=uniform(-8, 8, count, 3),
        f_dc=uniform(-1.5, 1.5, count, 1, 3),
        f_rest=uniform(-0.8, 0.8, count, (degree + 1) ** 2 - 1, 3),
        opacity=uniform(-3.5, 3.5, count, 1),
        scaling=uniform(-7, 1, count, 3),
        rotation=torch.randn(count, 4, generator=stream),
    )


splats = st.builds(random_splat, st.integers(1, 70), st.integers(0, 3), st.integers(0, 1 << 31))


def shapes(splat: Model) -> torch.Tensor:
    """(N, 3, 3) covariances in units of the largest axis: what rotations are there for."""
    turn = rotation_matrices(torch.nn.functional.normalize(splat.rotation.double()))
    scales = (splat.scaling - splat.scaling.max(dim=1, keepdim=True).values).double().exp()
    half = turn * scales[:, None, :]
    return half @ half.transpose(1, 2)


def apart(one: Model, other: Model) -> dict[str, float]:
    """The largest difference of each kind of value, drawn colours and opacities in [0, 1]."""
    return {
        "xyz": _most(one.xyz, other.xyz),
        "colour": 0.28209479 * _most(one.f_dc, other.f_dc),
        "rest": _most(one.f_rest, other.f_rest),
        "opacity": _most(one.opacity.sigmoid(), other.opacity.sigmoid()),
        "scaling": _most(one.scaling, other.scaling),
        "shape": _most(shapes(one), shapes(other)),
    }


def _most(one: torch.Tensor, other: torch.Tensor) -> float:
    return float((one - other).abs().max()) if one.numel() else 0.0
