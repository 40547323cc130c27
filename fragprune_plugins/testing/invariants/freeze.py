"""Invariant 6: stage 2 moves the parameters that ``--train`` names, and nothing else."""

from __future__ import annotations

from typing import Any

import torch
from torch import Tensor

from fragprune_plugins.learning.schedule import Settings
from fragprune_plugins.testing.host import FAINT, Chance, Host, running, tensors
from fragprune_plugins.testing.invariants.case import Case, FixedThresholds, require

ASKED = {"opacity": {"opacities"}, "appearance": {"opacities", "sh", "colors"}}
"""Fields of the Gaussians whose gradients an engine works out; the others cost nothing."""


def freeze(case: Case) -> None:
    """In stage 2 only the parameters of ``--train`` and the thresholds change, to the bit."""
    driver = case.driver
    moving: dict[str, frozenset[str] | None] = {
        "opacity": driver.opacity,
        "appearance": driver.opacity | driver.colour,
        "all": None,
    }
    for train, named in moving.items():
        settings, drawn = Settings(iterations=9, train=train), FixedThresholds()  # type: ignore[arg-type]
        with running(settings, from_step=2, plugins=[drawn], **case.options()) as host:
            model, camera = host.model(20), host.camera()
            driver.use_bands(model, 1)  # every band takes part
            for iteration in (1, 2):
                host.step(model, camera, iteration)
            asking = _asking(driver, model)
            before, thresholds = tensors(driver, model), host.store(model).logits.detach().clone()
            bands = driver.bands(model)
            for iteration in (3, 4, 5, 6):
                host.step(model, camera, iteration)
                for name in driver.routine:
                    held = tensors(driver, model)
                    driver.actions()[name](model, host.arguments, Chance(iteration, 0.4))
                    _expect_held(held, tensors(driver, model), f"--train {train}: {name}")
            after = tensors(driver, model)
            require(driver.bands(model) == bands, f"--train {train}: a band was added")
            moved = {name for name in before if not torch.equal(before[name], after[name])}
            expected = set(before) if named is None else named & before.keys()
            require(
                moved == expected,
                f"--train {train}: moved {sorted(moved)}; expected {sorted(expected)}",
            )
            require(
                _asking(driver, model) == asking,
                f"--train {train}: left other parameters asking for a gradient than it found",
            )
            require(
                named is None or drawn.asking <= ASKED[train],
                f"--train {train}: the engine was asked for gradients of {sorted(drawn.asking)}",
            )
            learned = host.store(model)
            require(learned.steps == 4, f"--train {train}: {learned.steps} threshold steps of 4")
            require(not torch.equal(learned.logits, thresholds), "thresholds stood still")


def _asking(driver: Host, model: Any) -> set[str]:
    """The parameters that require a gradient."""
    return {name for name, value in driver.parameters(model).items() if value.requires_grad}


def _expect_held(before: dict[str, Tensor], after: dict[str, Tensor], what: str) -> None:
    """Require that a routine of the host changed nothing; the action may make rows faint."""
    for name, value in before.items():
        same_rows = value.shape == after[name].shape
        require(same_rows, f"{what} made {len(after[name])} rows of {len(value)}")
        held = (after[name] == value) | (after[name] == FAINT)
        require(held.all(), f"{what} changed {name}")
