"""Invariant 3: every Gaussian keeps its own threshold through all row operations of the host."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import torch
from hypothesis import HealthCheck, Phase, given, settings
from hypothesis import strategies as st

from fragprune_plugins.errors import AlignmentError
from fragprune_plugins.hosts.seams import Role
from fragprune_plugins.testing.host import Chance, expect_ancestors, joint, label
from fragprune_plugins.testing.invariants.case import COUNT, Case, require

MOST = 400  # rows after which a sequence of actions ends


def alignment(case: Case) -> None:
    """After any sequence of actions each row has the threshold of the row it descends from."""
    names = sorted(case.driver.actions())

    @settings(
        max_examples=case.examples,
        deadline=None,
        derandomize=True,
        database=None,
        suppress_health_check=list(HealthCheck),
        phases=[Phase.generate, Phase.shrink],
    )
    @given(
        st.lists(
            st.tuples(
                st.sampled_from(names), st.builds(Chance, st.integers(0, 99), st.floats(0.05, 0.6))
            ),
            min_size=1,
            max_size=7,
        )
    )
    def follow(sequence: list[tuple[str, Chance]]) -> None:
        with joint(**case.options()) as host:
            model, camera = host.model(COUNT), host.camera(16, 12)
            host.step(model, camera, 1)  # so that the host's optimizer has moments to move
            label(host, model)
            actions = host.driver.actions()
            for name, chance in sequence:
                chance = replace(chance)  # a fresh generator, also when Hypothesis tries again
                torch.manual_seed(chance.seed)  # hosts draw parents from the global stream
                actions[name](model, host.arguments, chance)
                expect_ancestors(host, model)
                if not 0 < len(host.adapter.means(model)) < MOST:
                    return
            require(host.render(camera, model)["render"].isfinite().all(), "pixels not finite")

    follow()
    _each_action_works(case, names)
    _rows_behind_the_store(case)


def _each_action_works(case: Case, names: list[str]) -> None:
    for name in names:  # each at least once, first and alone
        for seed in (1, 2):
            with joint(**case.options()) as host:
                model = host.model(COUNT)
                host.step(model, host.camera(16, 12), 1)
                label(host, model)
                host.driver.actions()[name](model, host.arguments, Chance(seed, 0.4))
                expect_ancestors(host, model)


def _rows_behind_the_store(case: Case) -> None:
    """A store that lost rows is refused at every use, with both counts."""
    with joint(**case.options()) as host, TemporaryDirectory() as folder:
        model, camera = host.model(COUNT), host.camera(16, 12)
        host.step(model, camera, 1)
        host.store(model).keep(torch.arange(COUNT) < COUNT - 6)
        uses: dict[str, Callable[[], Any]] = {"render": lambda: host.render(camera, model)}
        if case.has(Role.SAVE):
            uses["save"] = lambda: host.driver.save(model, Path(folder) / "point_cloud.ply")
        if case.has(Role.CAPTURE):
            uses["capture"] = lambda: host.driver.capture(model)
        for name, use in uses.items():
            try:
                use()
            except AlignmentError as error:
                counts = (str(COUNT) in error.found, str(COUNT - 6) in error.expected)
                require(all(counts), f"{name}: the error names other counts: {error}")
            else:
                raise AssertionError(f"{name} went on with {COUNT - 6} thresholds for {COUNT}")
