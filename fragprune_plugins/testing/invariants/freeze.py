"""Invariant 6: stage 2 moves what it names, and nothing else."""

from __future__ import annotations

import torch
from torch import Tensor

from fragprune_plugins.learning.schedule import Settings
from fragprune_plugins.testing.host import FAINT, Chance, running, tensors
from fragprune_plugins.testing.invariants.case import Case, require


def freeze(case: Case) -> str:
    """In stage 2 only what ``--train`` names and the thresholds change, to the bit."""
    driver = case.driver
    moving: dict[str, frozenset[str] | None] = {
        "opacity": driver.opacity,
        "appearance": driver.opacity | driver.colour,
        "all": None,
    }
    for train, named in moving.items():
        with running(Settings(iterations=9, train=train), from_step=2, **case.options()) as host:  # type: ignore[arg-type]
            model, camera = host.model(20), host.camera()
            driver.use_bands(model, 1)  # every band takes part
            for iteration in (1, 2):
                host.step(model, camera, iteration)
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
            learned = host.store(model)
            require(learned.steps == 4, f"--train {train}: {learned.steps} threshold steps of 4")
            require(not torch.equal(learned.logits, thresholds), "thresholds stood still")
    return f"{len(moving)} choices of --train, {len(driver.routine)} routines"


def _expect_held(before: dict[str, Tensor], after: dict[str, Tensor], what: str) -> None:
    """Require that a routine of the host changed nothing; its action itself makes rows faint."""
    for name, value in before.items():
        same_rows = value.shape == after[name].shape
        require(same_rows, f"{what} made {len(after[name])} rows of {len(value)}")
        held = (after[name] == value) | (after[name] == FAINT)
        require(held.all(), f"{what} changed {name}")
