"""Invariant 2: neutral thresholds change no bit."""

from __future__ import annotations

import random
from dataclasses import replace
from typing import Any

import numpy as np
import torch

from fragprune_plugins.learning.goals import Pressure
from fragprune_plugins.learning.schedule import Schedule, Settings
from fragprune_plugins.testing.host import Chance, Running, alone, joint, running, tensors
from fragprune_plugins.testing.invariants.case import COUNT, Case, require


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
    _compare(own, followed)
    _opened_changes_nothing(case)


_STEPS = 6


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


def _compare(own: dict[str, Any], followed: dict[str, Any]) -> None:
    require(own.keys() == followed.keys(), f"{sorted(own)} became {sorted(followed)}")
    for name, value in own.items():
        require(torch.equal(value, followed[name]), f"{name} differ from the host's own")


def _opened_changes_nothing(case: Case) -> None:
    """Newly opened thresholds change no pixel, and gradients only by rounding."""
    pictures, gradients = [], []
    for opened in (False, True):
        with joint(Settings(iterations=9, goal=Pressure(0.0), stop=None), **case.options()) as host:
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
