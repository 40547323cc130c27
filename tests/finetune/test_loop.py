"""Stage 2 without a host: what moves, what stays, where it lands."""

import gc
import random
from dataclasses import replace

import pytest
import torch
from finetune import tiny
from torch.optim.optimizer import register_optimizer_step_post_hook

from fragprune_plugins import Control, Faster, Portable, Pressure, ThresholdStore, finetune, measure
from fragprune_plugins.engines import create_engine
from fragprune_plugins.errors import AlignmentError, DivergedError, EngineError, UsageError
from fragprune_plugins.learning.schedule import Schedule, Settings
from fragprune_plugins.learning.targets import calibrate
from fragprune_plugins.workbench.finetune import faster, loop

ALL = ("xyz", "f_dc", "f_rest", "opacity", "scaling", "rotation")


@pytest.fixture(scope="module")
def default(model, dataset):
    return finetune(model, dataset, Settings(iterations=60, goal=Pressure(1e-3)))


@pytest.mark.parametrize(
    ("train", "moving"),
    [("opacity", {"opacity"}), ("appearance", {"opacity", "f_dc", "f_rest"}), ("all", set(ALL))],
)
def test_what_is_not_named_stays_to_the_bit(model, dataset, train, moving):
    before = {name: getattr(model, name).clone() for name in ALL}
    result = finetune(model, dataset, Settings(iterations=8, train=train))
    for name in ALL:
        assert torch.equal(getattr(model, name), before[name]), "the input model was changed"
        moved = not torch.equal(getattr(result.model, name), before[name])
        assert moved == (name in moving), name
        assert not getattr(result.model, name).requires_grad


@pytest.mark.parametrize(
    ("settings", "times"),
    [
        (Settings(iterations=1, dropout=0.2), 4),
        (Settings(iterations=1), 1),
        (Settings(iterations=1, dropout=0.2, itself=True), 1),
        (Settings(iterations=1, dropout=0.2, train="appearance"), 1),
    ],
)
def test_photographs_with_dropout_teach_all_at_four_times_the_rates(
    model, dataset, settings, times
):
    """Adam's first step is the rate, whatever the gradient: 0.0025 for colours in 3DGS."""
    moved = finetune(model, dataset, settings).model.f_dc - model.f_dc
    assert float(moved.abs().max()) == pytest.approx(0.0025 * times, rel=1e-3)


@pytest.mark.parametrize("goal", [Pressure(), Portable(), Control()])
def test_while_gaussians_move_shapes_and_colours_learn_at_four_times_rates(model, dataset, goal):
    none = torch.empty(0, dtype=torch.int64)  # what has moved shows more than Adam's step
    result = finetune(model, dataset, Settings(iterations=1, goal=goal), relocate=none)
    for name, rate in {"f_dc": 4 * 0.0025, "scaling": 4 * 0.005, "opacity": 0.01}.items():
        moved = getattr(result.model, name) - getattr(model, name)
        assert float(moved.abs().max()) == pytest.approx(rate, rel=1e-3), name


@pytest.mark.parametrize("part", ["image", "fragments_per_pixel"])
def test_an_engine_that_gives_no_gradient_cannot_learn(model, dataset, part):
    class Flat:
        name = "flat"

        def rasterize(self, inputs, thresholds):
            outputs = create_engine("cpu").rasterize(inputs, thresholds)
            return replace(outputs, **{part: getattr(outputs, part).detach()})

    with pytest.raises(EngineError, match="without a gradient"):
        finetune(model, dataset, Settings(iterations=8), engine=Flat())


def test_nothing_waits_for_a_collection_after_it(model, dataset):
    """A search trains several times, and moments are twice as large as the model."""
    gc.disable()
    try:
        result = finetune(model, dataset, Settings(iterations=2, goal=Pressure(1e-3)))
        kinds = [type(each).__name__ for each in gc.get_objects()]
        assert (result.progress.steps, kinds.count("Training"), kinds.count("Adam")) == (2, 0, 0)
    finally:
        gc.enable()


@pytest.mark.skipif(torch.__version__ < "2.4", reason="torch fuses no Adam on a CPU")
def test_every_optimizer_steps_in_the_fused_kernel(model, dataset):
    seen = []

    def note(optimizer, *_):
        seen.extend(group["fused"] for group in optimizer.param_groups)

    with register_optimizer_step_post_hook(note):
        finetune(model, dataset, Settings(iterations=2, goal=Pressure(1e-3)))
    assert len(seen) == 2 * (len(ALL) + 1)  # and the thresholds'
    assert all(seen)


def test_loss_falls_and_fragments_fall(default, model, dataset):
    passed = len(dataset.train)  # views differ more than steps do
    first, last = (
        sum(point.loss for point in part) / passed
        for part in (default.curves[:passed], default.curves[-passed:])
    )
    assert last < first
    before, after = (
        measure(each, dataset, repeats=1)["fragments_per_pixel"] for each in (model, default.model)
    )
    assert after < 0.9 * before
    assert default.progress.speedup == pytest.approx(before / after, rel=0.1)
    assert default.progress.steps == 60
    assert default.progress.target_reached is None
    assert [point.step for point in default.curves] == list(range(1, 61))


@pytest.mark.parametrize("goal", [Control(), Pressure(1e-3)])
def test_what_dropout_leaves_out_counts_before_learning(model, dataset, goal):
    whole, part = (Settings(iterations=1, goal=goal, dropout=share) for share in (None, 0.5))
    before = finetune(model, dataset, whole).progress.fragments_before
    assert finetune(model, dataset, part).progress.fragments_before == before


def test_same_seed_same_result_and_global_streams_untouched(default, model, dataset):
    torch.manual_seed(7)
    random.seed(7)
    states = torch.random.get_rng_state(), random.getstate()
    again = finetune(model, dataset, Settings(iterations=60, goal=Pressure(1e-3)))
    assert torch.equal(states[0], torch.random.get_rng_state())
    assert states[1] == random.getstate()
    assert torch.equal(again.model.opacity, default.model.opacity)
    assert torch.equal(again.model.thresholds.logits, default.model.thresholds.logits)
    other = finetune(model, dataset, Settings(iterations=60, goal=Pressure(1e-3), seed=1))
    assert not torch.equal(other.model.opacity, default.model.opacity)


class Noting:
    """The engine of this machine, which notes the rules of each picture and whether it was cut."""

    name = "noting"

    def __init__(self):
        self.engine, self.seen = create_engine("auto"), []

    def rasterize(self, inputs, thresholds):
        self.seen.append((inputs.stop, inputs.rim, thresholds is not None))
        return self.engine.rasterize(inputs, thresholds)


@pytest.mark.parametrize("truncate", [True, False], ids=["thresholds", "control"])
def test_rules_are_trained_with_from_the_first_step_and_kept(model, dataset, truncate):
    goal = Pressure() if truncate else Control()
    engine, settings = Noting(), Settings(iterations=3, stop=0.2, rim="soft", goal=goal)
    result = finetune(model, dataset, settings, engine=engine)
    seen = [(stop, cut) for stop, _, cut in engine.seen]
    assert seen == 3 * [(0.2, truncate), (None, False)]  # before: the model as it came
    assert {rim for _, rim, cut in engine.seen if cut} <= {"soft"}
    assert result.model.rules == {"stop": 0.2, "rim": "soft"}
    assert result.progress.speedup > 1.05
    engine = Noting()
    again = finetune(result, dataset, Settings(iterations=1), engine=engine)
    assert engine.seen[0] == (0.2, "soft", True)
    assert again.model.rules == {"stop": 0.2, "rim": "soft"}


def test_the_bar_says_when_it_warms_up(model, dataset, capsys):
    settings = Settings(iterations=4)
    finetune(model, dataset, settings, schedule=Schedule(settings, warmup=2), progress=True)
    names = [line.split(":")[0] for line in capsys.readouterr().err.split("\r") if "px" in line]
    assert list(dict.fromkeys(names)) == ["warm-up", "fine-tuning"]


def test_divergence_that_no_loss_shows_is_noticed_before_there_is_a_result(model, dataset):
    spoiled = replace(model, opacity=model.opacity.clone())
    spoiled.opacity[:2] = torch.nan  # not drawn, so not in the loss either
    with pytest.raises(DivergedError, match=rf"opacity \(2 of {len(model)} rows\)"):
        finetune(spoiled, dataset, Settings(iterations=3))


@pytest.mark.parametrize(("bad", "rows"), [(torch.nan, 3), (torch.inf, 1), (1e25, 2)])
def test_gradients_that_are_not_finite_stop_their_step(model, dataset, monkeypatch, bad, rows):
    """1e25 is finite; its square, which Adam keeps, is not."""
    draw = loop.Training._draw

    def drawing(run, shot):
        if run.done == 4:
            spoiled = torch.full((rows, 1), bad)
            run.model.opacity.register_hook(lambda each: torch.cat([spoiled, each[rows:]]))
        return draw(run, shot)

    monkeypatch.setattr(loop.Training, "_draw", drawing)
    with pytest.raises(DivergedError) as caught:
        finetune(model, dataset, Settings(iterations=9))
    assert caught.value.where.startswith("stage 2, step 5, view view0")
    assert f"the gradient of opacity ({rows} of 60 rows)" in caught.value.found


def test_going_on_from_a_result_leaves_that_result_alone(default, dataset):
    before = tiny.state(default.model)
    result = finetune(default, dataset, Settings(iterations=3))
    now, start = result.model.thresholds, default.model.thresholds
    assert now.steps == start.steps + 3
    assert 0 < float((now.logits - start.logits).detach().abs().max()) < 0.5
    for name, each in tiny.state(default.model).items():
        assert torch.equal(each, before[name]), name


@pytest.mark.parametrize("rows", [0, 1, 61])
def test_thresholds_of_another_model_are_refused_with_both_counts(model, rows):
    with pytest.raises(AlignmentError, match=f"{rows} thresholds; expected 60"):
        replace(model, thresholds=ThresholdStore(rows))


def test_calibration_keeps_the_nearest_end_when_out_of_reach():
    store = ThresholdStore(3)
    calls = []

    def speedup():
        calls.append(float(store.logits.detach()[0]))
        return 1.0

    assert calibrate(store, speedup, 2.0, rounds=6) == 1.0
    assert len(calls) == 7
    assert calls[-1] > calls[0]


def test_a_target_time_that_no_threshold_reaches_is_refused_first(model, dataset, monkeypatch):
    tiny.exact_clock(monkeypatch, base=1e3)
    with pytest.raises(UsageError, match=r"less than 1\.\d\dx"):
        finetune(model, dataset, Settings(iterations=9, goal=Faster(1.5)), engine="cpu")


@pytest.mark.parametrize("noise", [0.0, 0.01])
def test_calibration_meets_what_is_measured_through_a_prediction_that_errs(monkeypatch, noise):
    store, stream, target = ThresholdStore(4), random.Random(0), faster.FrameTarget(1.6)
    store.open(torch.full((4,), 0.5))

    def predicted():
        return 1 / (1 - float(store.values.detach().mean()))

    def measured(views):
        return predicted() ** 0.5 * (1 + noise * (2 * stream.random() - 1))

    monkeypatch.setattr(target, "measure", measured)
    target.meet(store, predicted, ())
    assert target.met == pytest.approx(1.6, rel=0.01 + noise)
    assert predicted() ** 0.5 == pytest.approx(1.6, rel=0.01 + 2 * noise)
