"""A model that knows its photographs by heart, and what it then learns with."""

import gc
import weakref
from dataclasses import dataclass

import pytest
import torch
from cli.commands import run_json
from finetune import tiny

from fragprune_plugins.engines import create_engine
from fragprune_plugins.learning.schedule import Settings
from fragprune_plugins.plugins.hookspecs import hookimpl
from fragprune_plugins.workbench.finetune import trial
from fragprune_plugins.workbench.finetune.trial import BY_HEART, DROPOUT, KEEP, forgotten
from fragprune_plugins.workbench.scenes.dataset import Dataset, Shot


@dataclass(frozen=True, eq=False)
class Inverted(Shot):
    """A photograph in colours that no other one shows."""

    true: torch.Tensor

    @property
    def image(self):
        return 1 - self.true


@pytest.fixture(scope="module")
def engine():
    return create_engine("cpu")


@pytest.fixture(scope="module")
def photographs(dataset):
    return Dataset([*dataset.train, *dataset.test], [])


def test_what_holds_for_all_photographs_is_not_forgotten(model, photographs, engine):
    assert forgotten(model, photographs, engine=engine) < 0


def test_what_holds_for_some_photographs_alone_is_forgotten(truth, photographs, engine):
    shots = [
        shot if number % 2 else Inverted(shot.name, shot.view, shot.image)
        for number, shot in enumerate(photographs.train)
    ]
    assert forgotten(truth, Dataset(shots, []), engine=engine) > 10 * BY_HEART


def test_a_pruned_model_is_tried_with_its_cutoffs(model, photographs, engine):
    cut, drawn = tiny.cut(model, 0.3), []

    class Listening:
        def rasterize(self, inputs, thresholds):
            drawn.append(thresholds)
            return engine.rasterize(inputs, thresholds)

    forgotten(cut, photographs, engine=Listening())
    whole = len(photographs.train[::2])  # a view's first visit counts its fragments without cutoffs
    assert sum(each is None for each in drawn) == whole
    assert all(torch.equal(each, cut.falloff) for each in drawn if each is not None)
    assert len(drawn) > 100 + whole


def test_few_photographs_tell_nothing(model, dataset, engine):
    assert len(dataset.train) == 7
    assert forgotten(model, dataset, engine=engine) is None


def test_a_trial_leaves_no_trace(model, photographs, engine, plug):
    heard = []

    class Observer:
        @hookimpl
        def fragprune_step(self, stats):
            heard.append(stats)

    plug(Observer())
    before, state = model.xyz.clone(), torch.random.get_rng_state()
    first = forgotten(model, photographs, engine=engine)
    assert first == forgotten(model, photographs, engine=engine)
    assert heard == []
    assert torch.equal(model.xyz, before)
    assert torch.equal(torch.random.get_rng_state(), state)


@pytest.fixture
def command(tmp_path, monkeypatch):
    """Runs ``finetune`` with what a trial is to find; it fails if None and a trial is made."""
    data, path, _ = tiny.scene(tmp_path)

    def tuned(found, *options, model=path):
        def stand_in(*_, **__):
            assert found is not None, "nothing was to be tried"
            return found

        monkeypatch.setattr(trial, "forgotten", stand_in)
        out = tmp_path / "out.ply"
        return run_json(
            "finetune", model, "--data", data, "--out", out, "--iters", 4, "--again", *options
        )

    return tuned


@pytest.mark.parametrize(
    ("found", "options", "dropout", "keep"),
    [
        (BY_HEART, (), DROPOUT, KEEP),
        (BY_HEART, ("--keep", 1), DROPOUT, 1),
        (BY_HEART, ("--target-speedup", 1.2), DROPOUT, None),
        (BY_HEART - 0.01, (), None, "auto"),
        (BY_HEART - 0.01, ("--keep", 1), None, 1),
        (BY_HEART - 0.01, ("--target-speedup", 1.2), None, None),
        (BY_HEART, ("--portable",), DROPOUT, KEEP),
        (BY_HEART - 0.01, ("--portable",), None, "auto"),
    ],
)
def test_the_trial_chooses_what_nobody_chose(command, found, options, dropout, keep):
    report = command(found, *options)
    assert (report["settings"]["dropout"], report["keep"]) == (dropout, keep)
    assert report["forgotten"] == found
    share = report["after"]["gaussians"] / 60
    assert share < 1 if keep == "auto" else share == (keep or 1)


@pytest.mark.parametrize(
    ("lost", "said"),
    [
        (BY_HEART, "it does, so it learns with dropout 0.2 and without four in ten Gaussians"),
        (0.0, "it does not, so it learns without Gaussians that its photographs can spare"),
    ],
)
def test_the_trial_says_what_follows_and_names_no_option(
    model, photographs, engine, monkeypatch, lost, said
):
    """``run``, which makes it too, has not all of ``finetune``'s options."""
    heard = []
    monkeypatch.setattr(trial, "forgotten", lambda *_, **__: lost)
    trial.tried(model, photographs, Settings(), engine=engine, say=heard.append)
    assert heard[-1].endswith(said)


def test_of_a_pruned_model_no_gaussian_is_removed(command, tmp_path):
    command(BY_HEART - 0.01)
    pruned = (tmp_path / "out.ply").rename(tmp_path / "pruned.ply")
    report = command(BY_HEART, model=pruned)
    assert (report["settings"]["dropout"], report["keep"]) == (DROPOUT, None)


@pytest.mark.parametrize(
    ("options", "dropout"),
    [
        (("--dropout", 0.3), 0.3),
        (("--dropout", 0), 0.0),
        (("--control",), None),
        (("--self",), None),
        (("--train", "opacity"), None),
        (("--max-drop", 5), None),
    ],
)
def test_nothing_is_tried_where_somebody_chose_or_nothing_may_be(command, options, dropout):
    report = command(None, *options)
    assert report["settings"]["dropout"] == dropout
    assert report["forgotten"] is None


def test_of_a_trial_nothing_is_left_in_a_gpus_memory(model, photographs, engine, monkeypatch):
    """What waits for Python's collection is not free when the training itself begins."""
    made = []

    class Noted(trial.Training):
        def __init__(self, *given):
            super().__init__(*given)
            made.append(weakref.ref(self))

    monkeypatch.setattr(trial, "Training", Noted)
    gc.disable()
    try:
        forgotten(model, photographs, engine=engine)
        assert [each() for each in made] == [None]
    finally:
        gc.enable()
