"""Invariant 6: stage 2 moves what it names, and nothing else."""

from __future__ import annotations

import torch

from fragprune_plugins.learning.schedule import Settings
from fragprune_plugins.testing.host import Chance, running, tensors
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
                    driver.actions()[name](model, host.arguments, Chance(iteration, 0.4))
            after = tensors(driver, model)
            require(host.adapter.rows(model) == 20, f"--train {train}: rows were added or removed")
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
