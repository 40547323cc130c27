"""Invariant 8: every engine draws the same picture."""

from __future__ import annotations

from dataclasses import replace

import torch
from torch import Tensor

from fragprune_plugins.engines import create_engine
from fragprune_plugins.errors import FragpruneError
from fragprune_plugins.learning.goals import Pressure
from fragprune_plugins.learning.schedule import Settings
from fragprune_plugins.testing.fresh import NotApplicable
from fragprune_plugins.testing.host import Chance, joint
from fragprune_plugins.testing.invariants.case import Case, FixedThresholds, open_all, require

IMAGE_TOLERANCE = 2e-5
"""About 2^-23 times the fragments of a pixel, with room for terms of both signs."""

GRADIENT_TOLERANCE = 1e-3
"""Of a tensor's largest entry: float32 sums over all pixels, divided by 1 - alpha >= 0.01."""


def same_picture(case: Case) -> None:
    """The engines of this machine agree on the host's picture and on every gradient."""
    others = []
    for name in ("cpu", "cuda"):
        try:
            create_engine(name)
        except FragpruneError:
            continue
        others.append(name)
    if not others:
        raise NotApplicable("no engine but the reference runs here")
    for seed in range(3):
        whole, counts = _drawn_by(case, "reference", seed, None)
        for name in others:
            (ours, own), truth = _drawn_by(case, name, seed, None), whole
            same = counts == own  # a fragment on a cut may fall either way by rounding
            require((~same).sum() <= 1 + same.numel() // 500, f"{name}: other fragments drawn")
            if not same.all():
                ours, _ = _drawn_by(case, name, seed, same)
                truth, _ = _drawn_by(case, "reference", seed, same)
            for key, expected in truth.items():
                limit, scale = GRADIENT_TOLERANCE, float(expected.abs().max()) + 1e-3
                if key == "picture":
                    limit, scale = IMAGE_TOLERANCE, max(1.0, float(expected.abs().max()))
                away = float((ours[key] - expected).abs().max()) / scale
                require(away < limit, f"{name}: {key} differs by {away:.2g}, more than {limit:g}")


def _drawn_by(
    case: Case, engine: str, seed: int, mask: Tensor | None
) -> tuple[dict[str, Tensor], Tensor]:
    """One engine's picture and gradients under the mask, and drawn fragments (H, W)."""
    fixed = FixedThresholds()
    settings = Settings(iterations=9, goal=Pressure(0.0), stop=None)
    with joint(settings, plugins=[fixed], engine=engine, **case.options()) as host:
        model, camera = host.model(24, seed=seed), host.camera(33, 17)
        store = open_all(host, model)
        package = host.render(camera, model)
        image = package["render"]
        with torch.no_grad():
            assert fixed.inputs is not None
            drawn = host.engine(image.device).rasterize(
                replace(fixed.inputs, counts=True), store.values
            )
        mask = torch.ones_like(drawn.fragments, dtype=torch.bool) if mask is None else mask
        weights = Chance(seed, 0.5).uniform(*image.shape) - 0.5
        (image * weights * mask).sum().backward()
        found = host.gradients(model) | {"thresholds": store.logits.grad}
        gradients = {f"gradient of {name}": each for name, each in found.items()}
    return {"picture": (image * mask).detach(), **gradients}, drawn.fragments
