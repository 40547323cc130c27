"""What experiments compare."""

from __future__ import annotations

import pytest
import torch
from finetune import tiny
from lab.catalogue import EXPERIMENTS
from lab.rules import shrunk, without_faint
from lab.scores import SCORES
from lab.tests.commands import run

from fragprune_plugins.errors import UsageError
from fragprune_plugins.learning.goals import Control, Pressure
from fragprune_plugins.learning.schedule import Settings


@pytest.mark.parametrize("name", EXPERIMENTS)
def test_every_arm_has_a_label_of_its_own_and_a_control_of_equal_length(name):
    experiment = EXPERIMENTS[name](Settings())
    assert experiment.name == name
    assert len({arm.label for arm in experiment.arms}) == len(experiment.arms)
    for arm in experiment.arms:
        control = experiment.control_of(arm)
        assert (control is None) == arm.is_control
        if control is not None:
            assert control.is_control
            assert control.settings.iterations == arm.settings.iterations
            assert control.settings.train == arm.settings.train


def test_rules_trains_everything_equally_long_and_moves_the_same():
    arms = EXPERIMENTS["rules"](Settings(iterations=700, train="appearance")).arms
    assert {(arm.settings.iterations, arm.settings.train) for arm in arms} == {(700, "appearance")}
    assert [arm.rule.name for arm in arms if arm.rule] == [
        *(f"falloff_threshold({tau})" for tau in (0.03, 0.07, 0.12, 0.2)),
        *(f"alpha_cutoff({levels})" for levels in (4, 8, 12, 16)),
    ]
    goals = [arm.settings.goal for arm in arms if arm.series == "learned"]
    assert goals == [Pressure(weight) for weight in (None, 5e-5, 1e-4, 2e-4, 4e-4)]


def test_primitives_prunes_by_every_published_score_without_and_with_thresholds():
    arms = [arm for arm in EXPERIMENTS["primitives"](Settings(iterations=700)).arms if arm.pruning]
    alone = [arm.pruning for arm in arms if arm.settings.goal == Control()]
    assert alone == [arm.pruning for arm in arms if arm.settings.goal == Pressure()]
    assert {each.score for each in alone} == set(SCORES)
    assert {each.keep for each in alone} == {0.4, 0.6, 0.8}


def test_portable_compares_area_pressure_with_changes_before_training():
    experiment = EXPERIMENTS["portable"](Settings(iterations=700))
    learned = [arm for arm in experiment.arms if arm.settings.goal.on_area]
    assert [arm.settings.goal.weight for arm in learned] == [2e-4, 4e-4, None]
    started = [arm for arm in experiment.arms if arm.start]
    assert [arm.start.name for arm in started] == ["shrunk(0.7)", "without_faint(0.15)"]
    assert all(not arm.is_control and arm.settings.goal == Control() for arm in started)
    with pytest.raises(UsageError, match="only shapes that move"):
        EXPERIMENTS["portable"](Settings(iterations=700, train="opacity"))


def test_a_start_shrinks_all_alike_or_removes_the_faint():
    model = tiny.random_model()
    small = shrunk(0.7).change(model).splats()
    torch.testing.assert_close(small.scales, 0.7 * model.splats().scales)
    opacities = model.splats().opacities
    limit = opacities.median().item()
    left = without_faint(limit).change(model).splats().opacities
    assert torch.equal(left, opacities[opacities >= limit])
    assert 0 < len(left) < len(model)


def test_overfitting_compares_lengths_and_openings():
    experiment = EXPERIMENTS["overfitting"](Settings())
    truncated = [
        (arm.settings.iterations, arm.warmup) for arm in experiment.arms if not arm.is_control
    ]
    assert truncated == [(500, 0), (1000, 0), (2000, 0), (5000, 0)] + [
        (5000, opens) for opens in (2000, 3000, 4000)
    ]


def test_schedules_compares_when_thresholds_learn():
    arms = EXPERIMENTS["schedules"](Settings(iterations=1000)).arms
    truncated = [(arm.warmup, arm.every) for arm in arms if not arm.is_control]
    assert truncated == [(0, None), (500, None), (800, None), (0, 100), (0, 25)]
    assert {arm.settings.iterations for arm in arms} == {1000}


@pytest.mark.parametrize("name", EXPERIMENTS)
def test_every_experiment_is_listed_with_its_question(name):
    listed = "".join(run("--help").stdout.split())
    asks = EXPERIMENTS[name](Settings()).asks
    assert name + "".join(asks.split()) in listed
