"""One model and one camera for renderers of others, and what our engine draws by their rules."""

import numpy as np
import torch

from fragprune_plugins import RasterInputs, ThresholdStore, look_at, rasterize
from fragprune_plugins.adapting import Model, RasterOutputs, View
from fragprune_plugins.workbench.models.cutoffs import decode, encode

COUNT = 600

EDGE = float(np.exp(-4))
"""Falloff at sqrt(8) standard deviations, beyond which none of them draws."""

HALF_PIXELS = 0.3 / 4
"""Pixels^2 that PlayCanvas, and SuperSplat on it, dilates by: they add 0.3 in half pixels."""


def a_view() -> View:
    eye, target, up = torch.tensor([[0.1, -0.2, 0.0], [0.0, 0.0, 3.0], [0.0, -1.0, 0.0]])
    return look_at(eye, target, up, width=160, height=120, fov_y=50)


def a_model(view: View) -> Model:
    """Gaussians all over the view in no order, each with a colour and a cutoff of its own.

    Depths are evenly spaced: a sort on the GPU leaves the order of equal ones to chance. Without
    view-dependent colour: Spark keeps that in few bits, whatever one asks for.
    """
    random = torch.Generator().manual_seed(1)

    def uniform(low: float, high: float, *shape: int) -> torch.Tensor:
        return torch.rand(*shape, generator=random) * (high - low) + low

    depth = torch.linspace(2, 5, COUNT)[torch.randperm(COUNT, generator=random), None]
    across = torch.stack([uniform(-w, w, COUNT) for w in (0.6, 0.45)], 1)
    to_world = torch.linalg.inv(view.viewmatrix.T)
    return Model(
        xyz=torch.cat([across * depth, depth], 1) @ to_world[:3, :3].T + to_world[:3, 3],
        f_dc=uniform(-1.5, 1.5, COUNT, 1, 3),
        f_rest=torch.zeros(COUNT, 0, 3),
        opacity=torch.logit(uniform(0.02, 0.97, COUNT, 1)),
        scaling=torch.log(uniform(0.01, 0.15, COUNT, 3)),
        rotation=torch.nn.functional.normalize(torch.randn(COUNT, 4, generator=random)),
        thresholds=ThresholdStore.from_falloff(uniform(1 / 255, 0.6, COUNT)),
    )


def ours(model: Model, view: View, dilation: float, falloff: torch.Tensor) -> RasterOutputs:
    """Our engine's picture, by the rules that the others follow by themselves."""
    splats = model.splats()
    inputs = RasterInputs(view, splats, dilation=dilation, alpha_max=1, counts=True, planes=())
    return rasterize(inputs, falloff, engine="cpu")


def falloffs(model: Model, truncated: bool = True) -> torch.Tensor:
    """The least falloff that is drawn of each Gaussian, (N,)."""
    tau = torch.from_numpy(decode(encode(model.falloff))) if truncated else torch.zeros(len(model))
    return tau.clamp(min=EDGE)


def firm(model: Model, view: View, dilation: float, falloff: torch.Tensor) -> np.ndarray:
    """Where no fragment is at its cutoff, (H, W): a few percent of Q more or less draw the same."""
    near = [ours(model, view, dilation, falloff**scale).fragments for scale in (0.97, 1.03)]
    return (near[0] == near[1]).numpy()


def psnr(a: np.ndarray, b: np.ndarray) -> float:
    return float(-10 * np.log10(np.mean((a - b) ** 2) + 1e-12))
