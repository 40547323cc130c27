import math

import pytest
from hypothesis import given
from hypothesis import strategies as st

from fragprune_plugins.errors import UsageError
from fragprune_plugins.learning import goals
from fragprune_plugins.learning.goals import Control, Fewer, Portable, Pressure
from fragprune_plugins.learning.pressure import (
    ELASTICITY,
    LEAST_PRESSURE,
    MOST_PRESSURE,
    ElasticPressure,
    Observation,
    PressureController,
    PressureRule,
)
from fragprune_plugins.learning.schedule import USUAL_STOP, JointSchedule, Schedule, Settings
from fragprune_plugins.workbench.goals import AtMost, Faster, parse_goal


@given(st.integers(2, 10_000), st.sampled_from(["opacity", "appearance", "all"]))
def test_the_rates_of_stage_two_fall_tenfold(iterations, train):
    settings = Settings(iterations=iterations, train=train, threshold_lr=0.05, opacity_lr=0.01)
    schedule = Schedule(settings)
    first, last = schedule.at(settings.warmup + 1), schedule.at(iterations)
    assert (first.threshold_lr, first.progress) == (0.05, 0.0)
    assert schedule.at(1).opacity_lr == 0.01
    assert last.threshold_lr == pytest.approx(0.005)
    assert last.opacity_lr == pytest.approx(0.001)
    assert last.progress == schedule.at(iterations + 9).progress == 1.0
    middle = schedule.at((settings.warmup + iterations) // 2)
    assert last.threshold_lr <= middle.threshold_lr <= first.threshold_lr


@given(st.integers(1, 10_000), st.integers(1, 10_000))
def test_where_everything_moves_thresholds_learn_in_the_last_2000_steps(iterations, step):
    plan = Schedule(Settings(iterations=iterations, train="all")).at(step)
    assert plan.learn == (step > iterations - 2000)
    assert plan.counted  # so that fragments before are those of the model as it came in
    assert Schedule(Settings(iterations=iterations, train="opacity")).at(step).learn


@given(st.integers(1, 200), st.integers(0, 200))
def test_joint_learning_begins_at_its_step_and_leaves_the_opacity_rate_alone(step, start):
    plan = JointSchedule(Settings(iterations=200), start).at(step)
    assert plan.learn == (step >= start)
    assert plan.opacity_lr is None
    assert 0 <= plan.progress <= 1


@pytest.mark.parametrize(
    "wrong",
    [
        {"iterations": 0},
        {"iterations": 1.5},
        {"iterations": True},
        {"train": "everything"},
        {"goal": 1e-4},
        {"threshold_lr": -1},
        {"opacity_lr": math.nan},
        {"opacity_lr": "fast"},
        {"itself": 1},
        {"stop": 2.0},
        {"stop": "on"},
        {"seed": "x"},
        {"views_per_step": 0},
        {"goal": Portable(), "train": "opacity"},
        {"goal": Portable(), "stop": 0.01},
    ],
)
def test_settings_out_of_range_are_usage_errors_that_name_them(wrong):
    with pytest.raises(UsageError) as caught:
        Settings(**wrong)
    assert len(wrong) > 1 or next(iter(wrong)).replace("_", " ") == caught.value.where


@pytest.mark.parametrize(
    ("settings", "of_plain_models", "of_models_with_005"),
    [
        ({}, USUAL_STOP, 0.05),
        ({"goal": Fewer(2)}, USUAL_STOP, 0.05),
        ({"goal": Control()}, None, 0.05),
        ({"goal": Portable()}, None, 0.05),
        ({"itself": True}, None, 0.05),
        ({"stop": None}, None, 0.05),
        ({"stop": 0.05}, 0.05, 0.05),
        ({"stop": 0.05, "goal": Control()}, 0.05, 0.05),
    ],
)
def test_models_that_learn_thresholds_from_photographs_get_the_usual_stop(
    settings, of_plain_models, of_models_with_005
):
    stop_of = Settings(**settings).stop_of
    assert stop_of(None) == of_plain_models
    assert stop_of(0.05) == of_models_with_005


@pytest.mark.parametrize(
    ("made", "of"),
    [
        *((Pressure, wrong) for wrong in (-1e-9, 1.0, math.nan, "x", True)),
        *((Portable, wrong) for wrong in (-1e-9, 1.0, math.nan)),
        *((Fewer, wrong) for wrong in (1.0, 21.0, math.nan, None)),
        *((Faster, wrong) for wrong in (1.0, 21.0, math.nan)),
        *((AtMost, wrong) for wrong in (-0.1, 10.1, math.nan)),
        *((parse_goal, text) for text in ("", "fewer", "fewer=x", "control=2", "best")),
        (parse_goal, "faster=0.5"),
        *((type(goal).target, goal) for goal in (Faster(2), AtMost(0.1))),  # by one training
    ],
)
def test_what_is_no_goal_is_a_usage_error(made, of):
    with pytest.raises(UsageError):
        made(of)


@pytest.mark.parametrize(
    ("goal", "text"),
    [
        (Pressure(), "pressure"),
        (Pressure(3e-4), "pressure=0.0003"),
        (Fewer(2), "fewer=2"),
        (Faster(1.4), "faster=1.4"),
        (AtMost(0.05), "at-most=0.05"),
        (Portable(1e-3), "portable=0.001"),
        (Control(), "control"),
    ],
)
def test_a_goal_is_its_name_and_its_number(goal, text):
    assert str(goal) == text
    assert parse_goal(text) == goal


def test_a_goal_that_one_training_cannot_meet_is_none_of_a_host():
    with pytest.raises(UsageError, match="one of pressure, fewer, portable, control"):
        goals.parse_goal("faster=1.4")


def test_settings_choose_their_pressure():
    assert Settings(train="opacity").make_pressure() == ElasticPressure()
    assert Settings().make_pressure() == ElasticPressure(elasticity=2 * ELASTICITY)
    assert JointSchedule(Settings(), 1).make_pressure() == ElasticPressure()
    assert Settings(goal=Pressure(3e-4)).make_pressure() == PressureRule(3e-4)
    assert isinstance(Settings(goal=Fewer(1.8)).make_pressure(), PressureController)
    assert Settings(goal=Control()).make_pressure() == PressureRule(0.0)


GIVEN = Settings(5000, dropout=0.2, goal=Pressure(3e-5))


@pytest.mark.parametrize(
    ("settings", "least"),
    [
        (Settings(5000, dropout=0.2), 2e-4),
        (Settings(1000, dropout=0.2), LEAST_PRESSURE),  # thresholds learn from the first step on
        (Settings(5000, dropout=0.0), LEAST_PRESSURE),
        (Settings(5000), LEAST_PRESSURE),
        (Settings(5000, dropout=0.2, train="opacity"), LEAST_PRESSURE),
        (JointSchedule(Settings(5000, dropout=0.2), 1), LEAST_PRESSURE),
        (GIVEN, 3e-5),
    ],
)
def test_a_warm_up_with_dropout_bears_more_pressure_unless_it_is_given(settings, least):
    pressure = settings.make_pressure()
    assert pressure.value == least
    pressure.observe(Observation(0.5, fragments=40.0, ratio=1.0, loss=1e-9))
    assert pressure.value == least


def observed(losses, fragments):
    """The default pressure after steps of these losses and fragments."""
    pressure = ElasticPressure()
    for loss, drawn in zip(losses, fragments, strict=True):
        pressure.observe(Observation(0.5, drawn, 99.0 / drawn, loss))
    return pressure.value


@given(st.floats(1e-3, 0.3), st.floats(1, 200), st.floats(0.1, 10))
def test_the_default_pressure_is_a_share_of_the_loss_per_fragment(loss, fragments, scale):
    value = observed([loss] * 3, [fragments] * 3)
    share = ELASTICITY * loss / fragments
    assert value == pytest.approx(sorted([LEAST_PRESSURE, share, MOST_PRESSURE])[1])
    if all(LEAST_PRESSURE < each < MOST_PRESSURE for each in (value, scale * value)):
        assert observed([loss * scale] * 3, [fragments] * 3) == pytest.approx(value * scale)


@given(st.floats(1.01, 1000))
def test_a_loss_that_stays_while_fragments_fall_does_not_drive_the_default_pressure_up(fewer):
    """Noise in the photographs is such a loss: 0.2 where its standard deviation is 0.1."""
    pressure = Settings().make_pressure()
    for fragments in (30.0, 30.0 / fewer):
        pressure.observe(Observation(0.5, fragments, 35.0 / fragments, 0.2))
        assert pressure.value == MOST_PRESSURE


def test_the_default_pressure_averages_views_and_skips_losses_that_are_none():
    expected = ELASTICITY * (0.02 + 0.04) / (10 + 30)
    assert observed([0.02, 0.04], [10.0, 30.0]) == pytest.approx(expected)
    none = [float("nan"), float("inf"), 0.0, -1.0]
    assert observed([0.02, *none, 0.04], [10.0, 1, 1, 1, 1, 30.0]) == pytest.approx(expected)
    assert observed(none, [9.0] * 4) == LEAST_PRESSURE


def test_the_default_pressure_follows_a_loss_that_falls():
    assert observed([1.0] * 100 + [0.04] * 900, [20.0] * 1000) == pytest.approx(
        ELASTICITY * 0.04 / 20, rel=0.05
    )


@pytest.mark.parametrize(("reached", "direction"), [(1.0, 1), (3.0, -1)])
def test_a_controller_follows_the_ratio_that_it_is_given(reached, direction):
    pressure = PressureController(1.5, follows=0.4)
    start = pressure.value
    assert start > PressureController(1.5).value  # frames follow fragments only partly
    for step in range(100):
        pressure.observe(Observation(step / 100, 40, reached, 0.1))
    assert (pressure.value > start) == (direction > 0)


@pytest.mark.parametrize(("ratio", "direction"), [(1.0, 1), (0.1, -1)])
def test_a_controller_waits_then_moves_the_right_way_and_within_its_reach(ratio, direction):
    pressure = PressureController(1.8)
    start = pressure.value
    for step in range(15):
        pressure.observe(Observation(step / 100, 40 * ratio, 1 / ratio, loss=0.1))
    assert pressure.value == start  # warm-up
    for step in range(15, 100):
        pressure.observe(Observation(step / 100, 40 * ratio, 1 / ratio, loss=0.1))
    assert (pressure.value > start) == (direction > 0)
    assert start / 60.0001 <= pressure.value <= start * 60.0001
