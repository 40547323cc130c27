"""Invariant 4: a higher threshold never adds fragments, and can remove a Gaussian completely."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import torch
from torch import Tensor

from fragprune_plugins.learning.goals import Pressure
from fragprune_plugins.learning.schedule import Settings
from fragprune_plugins.testing.host import Chance, Running, joint
from fragprune_plugins.testing.invariants.case import Case, FixedThresholds, open_all, require


def monotone(case: Case) -> None:
    """A higher threshold adds no fragment; a completely truncated Gaussian leaves no trace."""
    for seed in range(5):
        fixed = FixedThresholds()
        with joint(plugins=[fixed], **case.options()) as host:
            model, camera = host.model(24, seed=seed), host.camera()
            open_all(host, model)
            chance = Chance(seed, 0.5)
            low, raised = 0.5 * chance.uniform(24), chance.rows(24)
            high = torch.where(raised, low + 0.4 * chance.uniform(24), low)
            (before, seen), (after, still_seen) = (
                _counted(host, fixed, model, camera, tau) for tau in (low, high)
            )
            own = before.fragments_per_gaussian
            require((after.fragments_per_gaussian <= own).all(), "a raised threshold added some")
            require(
                torch.equal(after.fragments_per_gaussian[~raised], own[~raised]),
                "a threshold that stood still drew other fragments",
            )
            require((after.fragments <= before.fragments).all(), "a pixel has more fragments")
            require(torch.equal(seen, still_seen), "radii, by which hosts densify, changed")
            require((seen > 0).any(), "no Gaussian has a radius, by which hosts densify")
            require(after.fragments.sum() < before.fragments.sum(), "nothing was truncated")
            fixed.values, behind = torch.full((24,), 1 - 1e-6), torch.tensor([0.2, 0.5, 0.9])
            empty = host.render(camera, model, behind)["render"].detach().cpu()
            away = float((empty - behind[:, None, None]).abs().max())
            require(away < 1e-6, f"nothing is drawn, and the background is off by {away:.2g}")
    _no_trace(case)


def _counted(
    host: Running, fixed: FixedThresholds, model: Any, camera: Any, tau: Tensor
) -> tuple[Any, Tensor]:
    """Draw through the host with thresholds, then again with counts; returns both and the radii."""
    fixed.values = tau
    package = host.render(camera, model)
    assert fixed.inputs is not None
    with torch.no_grad():
        drawn = host.engine(tau.device).rasterize(replace(fixed.inputs, counts=True), tau)
    return drawn, package["radii"]


def _no_trace(case: Case) -> None:
    """A fully truncated row 0 gives the picture and gradients of an invisible row 0."""
    results = []
    for cut in (True, False):
        fixed = FixedThresholds()
        with joint(
            Settings(iterations=9, goal=Pressure(0.0), stop=None), plugins=[fixed], **case.options()
        ) as host:
            model, camera = host.model(24), host.camera()
            open_all(host, model)
            # No pixel's falloff comes within the surrogate's reach of the highest threshold.
            tau = torch.full((24,), 1e-3)
            if cut:
                tau[0] = 1 - 1e-6
            else:
                host.driver.hide(model, 0)
            fixed.values = tau.requires_grad_()
            package = host.render(camera, model)
            package["render"].square().sum().backward()
            results.append((package["render"].detach(), host.gradients(model)))
    (image, gradients), (without, expected) = results
    torch.testing.assert_close(image, without, rtol=0, atol=1e-6)
    for name, gradient in gradients.items():
        rows = len(gradient) == len(tau)  # or it is shared by all Gaussians, as a network is
        gone = gradient[:1] if rows else gradient[:0]
        require((gone == 0).all(), f"{name}: a truncated Gaussian still has a gradient")
        others = slice(len(gone), None)
        torch.testing.assert_close(gradient[others], expected[name][others], rtol=1e-4, atol=1e-6)
