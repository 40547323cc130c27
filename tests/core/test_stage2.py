"""The core of stage 2, driven by hand: no host, no data set, no rasterizer."""

import json
import math
from collections.abc import Callable
from itertools import pairwise
from types import SimpleNamespace

import pytest
import torch

from fragprune_plugins import Control, Fewer, Portable, Pressure, ThresholdStore
from fragprune_plugins.errors import ResetError
from fragprune_plugins.learning.schedule import JointSchedule, Schedule, Settings, StepPlan
from fragprune_plugins.learning.stage2 import Stage2, evenly_spaced, stored_thresholds
from fragprune_plugins.workbench.finetune.faster import FrameTarget
from fragprune_plugins.workbench.finetune.processes import SharedStage
from fragprune_plugins.workbench.goals import TIME_FOLLOWS, Faster

OPACITIES = torch.linspace(0.2, 0.9, 5)


def drawing(store: ThresholdStore | None, fragments: float) -> SimpleNamespace:
    """What an engine gives, as far as stage 2 looks at it; falls as thresholds rise."""
    scale = 1.0 if store is None else 2 - store.values.mean()
    drawn = torch.as_tensor(fragments * scale)
    return SimpleNamespace(fragments_per_pixel=drawn, image=drawn / 100)


class Turns(Schedule):
    """Learns in every second step."""

    def at(self, step: int) -> StepPlan:
        return StepPlan(step % 2 == 1, 0.1, 0.02, step / 10, 0.25)


def learned(inputs, store: ThresholdStore) -> torch.Tensor | None:
    return None if store.neutral else store.values


def stage(**options) -> Stage2:
    settings = options.pop("settings", Settings(iterations=10, goal=Pressure(1e-2)))
    return Stage2(ThresholdStore(5), settings, truncate=learned, **options)


def step(it: Stage2, *views: str, loss: float = 0.5):
    it.begin(lambda: OPACITIES)
    terms = []
    for view in views:
        it.thresholds(None)
        term = it.on_drawn(view, drawing(it.store, 10.0), lambda: drawing(None, 20.0))
        it.on_loss(torch.tensor(loss))
        terms.append(term)
    pressure = [term for term in terms if term is not None]
    if pressure:
        sum(pressure).backward()
    it.end()
    return terms


def whole(it: Stage2, view: str = "a", fragments: float = 20.0):
    """A step in which a view is drawn without thresholds, and feels no pressure."""
    it.begin(lambda: OPACITIES)
    assert it.thresholds(None) is None
    drawn = drawing(None, fragments)
    assert it.on_drawn(view, drawn, lambda: drawn) is None
    it.end()
    assert it.store.neutral


def test_a_step_is_told_once_with_what_its_views_drew_and_lost():
    told = []
    it = stage(watch=told.append)
    step(it, "a", "b", loss=0.25)
    assert told == []  # not known whole before the next one begins
    step(it, "a")
    it.close()
    it.close()
    assert [stats.step for stats in told] == [1, 2]
    assert told[0].loss == pytest.approx(0.5)
    assert told[0].pressure == 1e-2
    progress = it.progress()
    assert (progress.steps, progress.gaussians, progress.target_reached) == (2, 5, None)
    assert progress.fragments_before == 20.0
    assert progress.speedup == pytest.approx(progress.fragments_before / progress.fragments_after)


def test_who_watches_may_end_the_run_and_is_not_told_twice():
    def end(stats):
        raise KeyboardInterrupt

    it = stage(watch=end)
    step(it, "a")
    with pytest.raises(KeyboardInterrupt):
        it.close()
    it.close()


def test_the_pressure_of_a_steps_views_is_their_mean():
    it = stage()
    step(it, "a", "b")  # how many views a step draws is known after the first
    first, second = step(it, "a", "b")
    assert first.detach() == pytest.approx(1e-2 / 2 * float(it._after["a", 0]))
    assert second is not None


def test_a_view_drawn_without_gradients_feels_no_pressure_and_is_no_first_visit():
    it = stage()
    it.begin(lambda: OPACITIES)
    with torch.no_grad():
        assert it.on_drawn("a", drawing(it.store, 10.0), lambda: drawing(None, 20.0)) is None
    assert not it.viewed
    assert it.progress().fragments_before is None


def test_a_step_that_does_not_learn_truncates_and_leaves_no_gradient_for_the_next():
    it = stage(settings=Settings(iterations=10, goal=Pressure(1e-2)))
    it.schedule = Turns(it.settings)
    step(it, "a")
    before = it.store.logits.detach().clone()
    it.begin(lambda: OPACITIES)
    held = it.thresholds(None)
    assert torch.equal(held, torch.sigmoid(before))
    assert not held.requires_grad
    it.end()
    assert torch.equal(it.store.logits.detach(), before)
    assert it.store.logits.grad is None


def test_a_warm_up_draws_without_thresholds_and_counts_what_came_in():
    told = []
    it = stage(settings=Settings(2001, train="all", goal=Pressure(1e-2)), watch=told.append)
    whole(it)
    assert not it.viewed
    step(it, "a")
    it.close()
    assert it.progress().fragments_before == 20.0
    assert [stats.fragments_per_pixel for stats in told] == [20.0, it.progress().fragments_after]
    assert told[1].fragments_per_pixel < 20.0


def test_fragments_before_and_after_are_of_the_same_views():
    it = stage(settings=Settings(iterations=2001, train="all", goal=Pressure(1e-2)))
    whole(it, "rich", 90.0)
    assert it.progress().fragments_before == 90.0
    step(it, "a")
    assert it.progress().fragments_before == 20.0


def test_rates_follow_the_schedule():
    it = stage(schedule=Turns(Settings(iterations=10)))
    assert it.rate("f_dc", 0.4) == 0.4
    it.begin(lambda: OPACITIES)
    assert it.rate("f_dc", 0.4) == pytest.approx(0.1)
    assert it.rate("opacity", 0.4) == 0.02


def test_a_control_draws_without_thresholds_and_still_counts():
    told = []
    it = stage(settings=Settings(iterations=10, goal=Control()), watch=told.append)
    whole(it)
    it.close()
    assert it.store.steps == 0
    assert [stats.fragments_per_pixel for stats in told] == [20.0]


@pytest.mark.parametrize("goal", [Control(), Portable()])
def test_what_learns_no_thresholds_keeps_none_that_its_pictures_do_not_have(goal, caplog):
    it = stage(settings=Settings(iterations=10, goal=goal))
    it.store.open(OPACITIES)
    for _ in range(2):
        it.begin(lambda: OPACITIES)
        assert it.thresholds(None) is None
        assert it.store.neutral
    assert len(caplog.messages) == 1


def test_a_loss_without_a_view_is_nobodys():
    it = stage()
    it.begin(lambda: OPACITIES)
    it.on_loss(torch.tensor(3.0))
    it.close()
    assert it.progress().fragments_before is None


def falling(goal, iterations, names="abc", **options) -> tuple[Stage2, dict[str, Callable]]:
    """A stage, and its views: their fragments fall from 20 to 0 as thresholds rise from 0 to 1."""
    views: dict[str, Callable] = {}
    it = stage(settings=Settings(iterations=iterations, goal=goal), views=views, **options)

    def draw(view):
        outputs = SimpleNamespace(fragments_per_pixel=20 * (1 - it.store.values.mean()))
        return it.on_drawn(view, outputs, lambda: drawing(None, 20.0))

    views |= {view: lambda view=view: draw(view) for view in names}
    return it, views


def take(it: Stage2, view: Callable) -> None:
    it.begin(lambda: OPACITIES)
    if (term := view()) is not None:
        term.backward()
    it.end()


@pytest.mark.parametrize("target", [1.2, 1.8])
def test_a_target_is_met_late_and_thresholds_then_stay(target):
    it, views = falling(Fewer(target), 20)
    held = []
    for number in range(20):
        take(it, views["abc"[number % 3]])
        held.append(not it.learning)
    progress = it.progress()
    assert held == [number >= 17 for number in range(20)]  # from 85 per cent of the run on
    assert progress.target_reached
    assert progress.speedup == pytest.approx(target, rel=0.02)


def clocked(ratio, measure):
    """A target in frame times, with a clock of its own."""
    target = FrameTarget(ratio)
    target.measure = measure
    return target


@pytest.mark.parametrize("fixed", [1.0, 5.0, 9.0])
def test_a_target_time_is_met_by_the_clock(fixed):
    def measure(shots):  # a frame takes a fixed time, and one by its fragments
        assert shots == ["a", "b", "c"]
        now = 20 * (1 - it.store.values.detach().mean())
        return (fixed + 20.0) / (fixed + float(now))

    it, views = falling(Faster(2.0), 20, target=clocked(2.0, measure))
    for number in range(20):
        take(it, views["abc"[number % 3]])
    progress = it.progress()
    assert progress.target_reached
    assert progress.faster == pytest.approx(2.0, rel=0.02)
    assert progress.faster == pytest.approx(measure(["a", "b", "c"]))
    left = (20 + fixed) / 2 - fixed
    assert progress.speedup == pytest.approx(20 / left, rel=0.1)  # of fragments


def test_what_the_clock_said_outlives_a_checkpoint():
    def make():
        return falling(Faster(2.0), 20, "a", target=clocked(2.0, lambda shots: 1.5))

    it, views = make()
    for _ in range(13):  # past two of the looks at the clock
        it.begin(lambda: OPACITIES)
        it.store.place(torch.zeros(5))  # half of the fragments
        views["a"]().backward()
        it.end()
    tensors, plain = it.state_dict()
    again, _ = make()
    again.load_state_dict(tensors, json.loads(json.dumps(plain)))
    assert again.target.slope() == it.target.slope() != TIME_FOLLOWS
    assert again.target.timed == it.target.timed == 2
    assert again.progress() == it.progress()


@pytest.mark.parametrize(("stop", "rim"), [(None, "hard"), (0.01, "soft")])
def test_what_a_stage_kept_gives_the_thresholds_alone(stop, rim):
    it = stage(settings=Settings(iterations=9, stop=stop, rim=rim))
    it.begin(lambda: OPACITIES)
    tensors, plain = it.state_dict()
    store = ThresholdStore(0)
    store.load_state_dict(stored_thresholds(tensors, json.loads(json.dumps(plain))))
    assert torch.equal(store.values, it.store.values)
    assert store.rules == {"stop": stop, "rim": rim}


def test_what_was_drawn_before_a_checkpoint_is_counted_on_the_gpu_of_what_is_drawn_after_it():
    """nerfstudio reads its checkpoints on the CPU; "meta" stands for a GPU."""
    it = stage()
    step(it, "a", "b")
    tensors, plain = it.state_dict("ab")
    again = Stage2(ThresholdStore(0, "meta"), it.settings, truncate=learned)
    again.load_state_dict(tensors, plain, "ab")
    kept = [*again._before.values(), *again._after.values()]
    assert [each.device.type for each in kept] == ["meta"] * 4


def test_no_target_makes_fragments_fewer_than_twentyfold():
    it, views = falling(Faster(2.0), 4, "a", target=clocked(2.0, lambda shots: 1.1))
    for _ in range(4):
        it.begin(lambda: OPACITIES)
        views["a"]()
        it.end()
    assert it.progress().target_reached is False
    assert float(1 - it.store.values.detach().mean()) >= 1 / 20 - 1e-3


def test_opacities_are_worked_out_only_while_there_are_rows_to_open():
    asked = []
    it = stage()

    def opacities():
        asked.append(it.steps)
        return torch.full((len(it.store),), 0.5)

    for count in range(1, 7):
        it.begin(opacities)
        it.end()
        if count == 3:
            it.store.append(2)
    assert asked == [1, 4]
    assert (it.store.logits > -30).all()


@pytest.mark.parametrize("count", [0, 1, 3, 4, 5, 11, 100])
def test_chosen_views_are_spread_over_all_of_them(count):
    chosen = evenly_spaced(range(count), 3)
    assert len(chosen) <= 3
    assert count == 0 or chosen[0] == 0
    gaps = [b - a for a, b in pairwise([*chosen, count])]
    assert max(gaps, default=0) <= math.ceil(count / 3)


def reset(share: float) -> torch.Tensor:
    """Opacities of 100 Gaussians, of which a host's reset has just lowered a share to 0.01."""
    return torch.where(torch.arange(100) < 100 * share, 0.01, 0.3)


def test_thresholds_do_not_begin_right_after_a_reset_of_opacities():
    it = Stage2(ThresholdStore(100), Settings(iterations=10), truncate=learned)
    with pytest.raises(ResetError, match=r"at most 0.01 in 95% of 100 Gaussians"):
        it.begin(lambda: reset(0.95))


@pytest.mark.parametrize(("goal", "share"), [(Pressure(), 0.8), (Control(), 1.0)])
def test_many_faint_gaussians_are_no_reset_and_a_control_may_follow_one(goal, share):
    it = Stage2(ThresholdStore(100), Settings(iterations=10, goal=goal), truncate=learned)
    it.begin(lambda: reset(share))
    assert it.store.opened == (goal != Control())


def test_joint_learning_warns_of_a_reset_and_goes_on_with_the_training(caplog):
    settings = Settings(iterations=10)
    schedule = JointSchedule(settings, from_step=1)
    it = Stage2(ThresholdStore(100), settings, schedule, truncate=learned)
    it.begin(lambda: reset(1.0))
    assert "[opacity-reset]" in caplog.text
    assert it.store.opened


def drawn_by_one(it: SharedStage, names: str) -> list[list[float]]:
    """A step begins, and these views are drawn; what another process is told of them."""
    it.begin(lambda: OPACITIES)
    for name in names:
        size = 1.0 + "ab".index(name)
        it.on_drawn(name, drawing(None, 8 * size), lambda size=size: drawing(None, 20 * size))
        it.on_loss(torch.tensor(size / 8))
    return it.figures()


@pytest.mark.parametrize("own", ["a", "b"])
def test_what_other_processes_drew_counts_like_ones_own_and_in_the_same_order(own):
    settings, told = Settings(iterations=10, goal=Pressure(1e-2), views_per_step=2), ([], [])
    whole, it = (
        SharedStage(
            ThresholdStore(5),
            settings,
            truncate=learned,
            views={"a": None, "b": None},
            watch=each.append,
        )
        for each in told
    )
    for _ in range(2):
        rows = drawn_by_one(whole, "ab")
        assert drawn_by_one(it, own) == [rows["ab".index(own)]]
        it.share("ab", torch.tensor(rows))
    (tensors, plain), (others, other) = whole.state_dict(), it.state_dict()
    assert told[0] == told[1]
    assert plain == other
    for name in ("before", "after"):
        assert torch.equal(tensors[name], others[name])


def test_what_is_drawn_before_the_first_step_leaves_no_gradient_for_it():
    it = stage()
    it.store.open(OPACITIES)
    it.thresholds(None).sum().backward()
    assert it.store.logits.grad.any()
    it.begin(lambda: OPACITIES)
    assert it.store.logits.grad is None


def test_a_step_of_the_hosts_own_training_is_no_step_of_it_and_is_not_looked_at():
    it = stage(parameters=lambda: {"xyz": torch.tensor([math.nan])})
    it.end()
    assert it.progress().steps == 0
