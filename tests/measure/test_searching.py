"""The strongest truncation within a bound: where it looks next, what it keeps, what it says."""

from dataclasses import make_dataclass
from types import SimpleNamespace

import pytest
from hypothesis import given
from hypothesis import strategies as st

from fragprune_plugins import AtMost, Control, Settings
from fragprune_plugins.learning.interruption import Terminate
from fragprune_plugins.workbench.finetune import searching
from fragprune_plugins.workbench.finetune.searching import (
    TOLERANCE,
    TRAININGS,
    Trial,
    next_pressure,
    strongest,
)


def search(loss_of, bound: float, start: float) -> list[Trial]:
    """The trials of a search in which a pressure loses what ``loss_of`` says."""
    trials, pressure = [], start
    while len(trials) < TRAININGS:
        trials.append(Trial(pressure, loss_of(pressure), 0.0, 1.0 / pressure))
        if bound - TOLERANCE <= trials[-1].loss <= bound:
            break
        pressure = next_pressure(trials, bound)
    return trials


@given(
    start=st.floats(5e-5, 2e-3),
    gain=st.floats(0.0, 0.4),
    slope=st.floats(100, 2000),
    power=st.floats(0.7, 1.2),
    bound=st.floats(0.0, 0.5),
)
def test_a_loss_that_grows_about_as_the_pressure_does_is_met(start, gain, slope, power, bound):
    def loss_of(pressure: float) -> float:
        return slope * 1e-4 * 10 * (pressure / 1e-3) ** power - gain

    trials = search(loss_of, bound, start)
    assert all(trial.pressure > 0 for trial in trials)
    reachable = loss_of(start / 4 ** (TRAININGS - 1)) <= bound <= loss_of(start * 4)
    if reachable and loss_of(start * 4**3) > bound:
        assert min(abs(trial.loss - (bound - TOLERANCE / 2)) for trial in trials) < 2 * TOLERANCE


@pytest.mark.parametrize(("loss", "less"), [(1.0, True), (-1.0, False)])
def test_a_loss_on_one_side_of_the_bound_ends_with_ever_less_or_more_pressure(loss, less):
    pressures = [trial.pressure for trial in search(lambda pressure: loss, 0.05, 2e-4)]
    assert len(pressures) == TRAININGS
    assert pressures == sorted(pressures, reverse=less)
    assert less or pressures[-1] > 30 * pressures[0]


Result = make_dataclass("Result", ["settings", "progress", "interrupted", "terminated"])


def train(settings):
    """A training that loses 1 dB at a pressure of 1e-3, in proportion, and is not made."""
    goal = settings.goal
    pressure = 0.0 if goal == Control() else 2e-4 if goal.weight is None else goal.weight
    progress = SimpleNamespace(pressure=pressure, fragments_before=40.0)
    return Result(settings, progress, False, False)


def searched(bound, train=train, say=lambda _: None, **settings):
    return strongest(train, Settings(goal=AtMost(bound), **settings), [], engine=None, say=say)


@pytest.fixture(autouse=True)
def _measured(monkeypatch):
    """Held-out views of such trainings."""

    def held_out(result, shots, engine):
        lost = 1000 * result.progress.pressure if result.settings.goal.presses else 0.0
        return [30.0 - lost, 32.0 - lost], 20.0 - 5 * lost

    monkeypatch.setattr(searching, "_held_out", held_out)


def test_the_strongest_within_the_bound_is_kept_and_the_control_trains_equally_long():
    said: list[str] = []
    trained: list[Settings] = []

    def noted(settings):
        trained.append(settings)
        return train(settings)

    found = searched(0.1, noted, said.append, iterations=77)
    assert found.trial is not None
    assert 0.1 - TOLERANCE <= found.trial.loss <= 0.1
    assert found.result.progress.pressure == found.trial.pressure
    assert {settings.iterations for settings in trained} == {77}
    assert [settings.goal.presses for settings in trained] == [False] + [True] * len(found.trials)
    assert found.as_dict()["met"]
    assert len(said) == 1 + 2 * len(found.trials)


def test_an_unreachable_bound_keeps_the_least_loss_and_says_so(monkeypatch):
    monkeypatch.setattr(
        searching,
        "_held_out",
        lambda result, shots, engine: ([30.0 - result.settings.goal.presses], 20.0),
    )
    found = searched(0.1)
    assert len(found.trials) == TRAININGS
    assert not found.as_dict()["met"]
    assert found.trial is not None
    assert found.trial.loss == pytest.approx(1.0)


def test_a_loss_that_never_reaches_the_bound_ends_before_a_pressure_that_is_none(monkeypatch):
    monkeypatch.setattr(searching, "_held_out", lambda result, shots, engine: ([30.0], 20.0))
    monkeypatch.setattr(searching, "next_pressure", lambda trials, bound: 9 * trials[-1].pressure)
    found = searched(5.0)
    assert found.as_dict()["met"]
    assert max(trial.pressure for trial in found.trials) <= 0.5


@pytest.mark.parametrize("stop", [KeyboardInterrupt, Terminate])
@pytest.mark.parametrize("at", [1, 2, 3])
def test_a_signal_while_views_are_measured_keeps_what_was_trained(monkeypatch, stop, at):
    measured, held_out = [], searching._held_out

    def signalled(*args):
        measured.append(args[0])
        if len(measured) == at:
            raise stop
        return held_out(*args)

    monkeypatch.setattr(searching, "_held_out", signalled)
    found = searched(0.1)
    kept = measured[1 if at == 3 else at - 1]  # the best that was measured, else the last
    assert found.result.settings == kept.settings
    assert found.result.interrupted
    assert found.result.terminated == (stop is Terminate)
    assert (found.trial is None) == (at < 3)
