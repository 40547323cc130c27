"""Invariants 2, 4 and 8: what is drawn, by neutral thresholds, by higher ones, by every engine."""

from __future__ import annotations

import contextlib
import random
from dataclasses import replace
from typing import Any

import numpy as np
import torch
from torch import Tensor

from fragprune_plugins.engines import create_engine
from fragprune_plugins.errors import FragpruneError
from fragprune_plugins.learning.goals import Pressure
from fragprune_plugins.learning.schedule import Schedule, Settings
from fragprune_plugins.testing.fresh import NotApplicable
from fragprune_plugins.testing.host import Chance, Running, alone, joint, running, tensors
from fragprune_plugins.testing.invariants.case import (
    COUNT,
    Case,
    FixedThresholds,
    open_all,
    require,
)

_STEPS = 6
_UNPRESSED = Settings(iterations=9, goal=Pressure(0.0), stop=None)


class NeverLearning(Schedule):
    """A schedule under which nothing learns."""

    def at(self, step: int) -> Any:
        """The plan, without learning."""
        return replace(super().at(step), learn=False)


def neutral_is_the_host(case: Case) -> None:
    """If nothing learns, parameters and random streams are the host's own, to the bit."""
    never = NeverLearning(Settings(iterations=20, stop=None))
    with alone(**case.options()) as host:
        own = _lifetime(host)
    with running(never.settings, schedule=never, freeze=False, **case.options()) as host:
        followed = _lifetime(host)
        require(host.last_state is not None, "the session never saw the model")
        require(host.last_state.steps == _STEPS, f"{host.last_state.steps} steps were counted")
    require(own.keys() == followed.keys(), f"{sorted(own)} became {sorted(followed)}")
    for name, value in own.items():
        require(torch.equal(value, followed[name]), f"{name} differ from the host's own")
    _opened_changes_nothing(case)


def _lifetime(host: Running) -> dict[str, Any]:
    """Take steps, with the training loop's other actions between them; returns the results."""
    torch.manual_seed(3)
    np.random.seed(3)
    random.seed(3)
    model, camera = host.model(COUNT), host.camera()
    actions = host.driver.actions()
    losses = []
    for iteration in range(1, _STEPS + 1):
        losses.append(host.step(model, camera, iteration))
        name = host.driver.routine[iteration % len(host.driver.routine)]
        actions[name](model, host.arguments, Chance(iteration, 0.3))
    return {
        **tensors(host.driver, model),
        "torch's random stream": torch.get_rng_state(),
        "numpy's random stream": torch.from_numpy(
            np.random.get_state(legacy=False)["state"]["key"].astype(np.int64)
        ),
        "python's random stream": torch.tensor(random.getstate()[1]),
        "losses": torch.tensor(losses),
    }


def _opened_changes_nothing(case: Case) -> None:
    """Newly opened thresholds change no pixel, and gradients only by rounding."""
    pictures, gradients = [], []
    for opened in (False, True):
        with joint(_UNPRESSED, **case.options()) as host:
            model, camera = host.model(40), host.camera()
            if opened:
                host.store(model).open(host.adapter.opacities(model))
            require(host.store(model).neutral != opened, "thresholds did not open")
            package = host.render(camera, model)
            (package["render"] - camera.original_image).square().sum().backward()
            pictures.append(package["render"].detach())
            gradients.append(host.gradients(model))
    require(torch.equal(*pictures), "freshly opened thresholds change the picture")
    require(gradients[0].keys() == gradients[1].keys(), "gradients reach other parameters")
    for name, gradient in gradients[0].items():
        # The same terms in the same order; the compiler may fuse them otherwise: a few roundings.
        same = torch.allclose(gradients[1][name], gradient, rtol=1e-6, atol=1e-9)
        require(same, f"freshly opened thresholds change the gradient of {name}")


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
            radii, drawn = [], []
            for tau in (low, high):
                fixed.values = tau
                radii.append(host.render(camera, model)["radii"])
                drawn.append(fixed.counted(host, tau))
            before, after = (each.fragments_per_gaussian for each in drawn)
            require((after <= before).all(), "a raised threshold added some")
            same = torch.equal(after[~raised], before[~raised])
            require(same, "a threshold that stood still drew other fragments")
            before, after = (each.fragments for each in drawn)
            require((after <= before).all(), "a pixel has more fragments")
            require(after.sum() < before.sum(), "nothing was truncated")
            require(torch.equal(*radii), "radii, by which hosts densify, changed")
            require((radii[0] > 0).any(), "no Gaussian has a radius, by which hosts densify")
            fixed.values, behind = torch.full((24,), 1 - 1e-6), torch.tensor([0.2, 0.5, 0.9])
            empty = host.render(camera, model, behind)["render"].detach().cpu()
            away = float((empty - behind[:, None, None]).abs().max())
            require(away < 1e-6, f"nothing is drawn, and the background is off by {away:.2g}")
    _no_trace(case)


def _no_trace(case: Case) -> None:
    """A fully truncated row 0 gives the picture and gradients of an invisible row 0."""
    results = []
    for cut in (True, False):
        fixed = FixedThresholds()
        with joint(_UNPRESSED, plugins=[fixed], **case.options()) as host:
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


IMAGE_TOLERANCE = 2e-5  # 2^-23 times a pixel's fragments, with room for both signs
GRADIENT_TOLERANCE = 1e-3  # of the largest: sums in float32, over 1 - alpha >= 0.01


def same_picture(case: Case) -> None:
    """The engines of this machine agree on the host's picture and on every gradient."""
    others = []
    for name in ("cpu", "cuda"):
        with contextlib.suppress(FragpruneError):
            create_engine(name)
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
    with joint(_UNPRESSED, plugins=[fixed], engine=engine, **case.options()) as host:
        model, camera = host.model(24, seed=seed), host.camera(33, 17)
        store = open_all(host, model)
        package = host.render(camera, model)
        image = package["render"]
        fragments = fixed.counted(host, store.values).fragments
        mask = torch.ones_like(fragments, dtype=torch.bool) if mask is None else mask
        weights = Chance(seed, 0.5).uniform(*image.shape) - 0.5
        (image * weights * mask).sum().backward()
        found = host.gradients(model) | {"thresholds": store.logits.grad}
        gradients = {f"gradient of {name}": each for name, each in found.items()}
    return {"picture": (image * mask).detach(), **gradients}, fragments
