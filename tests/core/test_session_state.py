"""What all handlers of a session share."""

from __future__ import annotations

import gc
import logging
import weakref
from pathlib import Path
from types import SimpleNamespace

import pytest
import torch
from core.sessions import Model, Role, call, follow, state

from fragprune_plugins.constants import NEUTRAL_LOGIT
from fragprune_plugins.errors import AlignmentError, SessionError, SidecarError
from fragprune_plugins.files import sidecar
from fragprune_plugins.files.atomic import staging
from fragprune_plugins.injection import state as module
from fragprune_plugins.learning.schedule import Settings
from fragprune_plugins.learning.thresholds import ThresholdStore

CPU = torch.device("cpu")


def test_what_it_is_given_is_what_it_has():
    schedule, settings = object(), Settings(iterations=7)
    session = state(
        settings=settings,
        schedule=schedule,
        from_step=3,
        start=5,
        engine="cpu",
        drop_in=True,
        output=Path("out"),
        origin=Path("one"),
    )
    assert (session.settings, session.schedule) == (settings, schedule)
    assert (session.learn, session.freeze) == (True, True)
    assert (session.from_step, session.start) == (3, 5)
    assert (session.engine_name, session.drop_in) == ("cpu", True)
    assert (session.output, session.origin) == (Path("out"), Path("one"))
    assert session.dialect == "dialect of host"
    assert (session.unpacked, session.last, session.last_state) == (None, None, None)
    assert (session.curves, session.absent, session.warned) == ([], set(), False)
    assert session.rendering.get() is None
    assert session.pausing.get() is False


def test_what_it_is_not_given_is_learned_from_the_first_step_by_the_plugins_schedule(monkeypatch):
    asked = []
    monkeypatch.setattr(module, "schedule_for", lambda *words: asked.append(words) or "theirs")
    session = state(schedule=None, settings=None)
    assert session.schedule == "theirs"
    assert asked == [(session.settings, session.plugins)]
    assert session.settings == Settings()
    assert (session.from_step, session.start, session.engine_name) == (0, 0, "auto")
    assert (session.drop_in, session.output, session.origin) == (None, None, None)


@pytest.mark.parametrize(("name", "warned"), [("cpu", False), ("reference", True)])
def test_an_engine_is_opened_once_for_a_device_and_a_slow_one_is_told(
    monkeypatch, caplog, name, warned
):
    asked = []
    engine = SimpleNamespace(name=name)
    monkeypatch.setattr(module, "engine_for", lambda *words: asked.append(words) or engine)
    session = state(engine="auto")
    with caplog.at_level(logging.WARNING, "fragprune"):
        assert session.engine(CPU) is session.engine(CPU) is engine
    assert asked == [("auto", CPU, session.plugins)]
    assert ["draws on cpu" in each.message for each in caplog.records] == [True] * warned


def test_a_model_is_known_by_itself_or_by_its_means():
    session = state()
    (first, _), (second, _) = follow(session), follow(session, 4)
    session.adapter.model_of = lambda call: call.instance
    assert session.model_of(call(first, Role.VIEW, len, [])) is first
    assert session.model_of(call(None, Role.VIEW, len, [])) is None
    assert session.model_of(call(second.xyz.detach(), Role.VIEW, len, [])) is second
    assert session.model_of(call(first.xyz.detach(), Role.VIEW, len, [])) is first
    assert session.model_of(call(torch.zeros(6, 3), Role.VIEW, len, [])) is None


@pytest.mark.parametrize(
    ("learn", "freeze", "from_step", "steps", "still"),
    [
        (True, True, 0, None, True),
        (True, True, 0, 0, True),
        (True, True, 3, None, False),
        (True, True, 3, 3, False),
        (True, True, 3, 4, True),
        (False, True, 0, 9, False),
        (True, False, 0, 9, False),
    ],
)
def test_a_frozen_model_stands_still_once_stage_two_has_begun(
    learn, freeze, from_step, steps, still
):
    session = state(learn=learn, freeze=freeze, from_step=from_step)
    model, known = follow(session)
    if steps is None:
        model = Model(3)
    else:
        known.steps = steps
    assert session.standing_still(model) is still


def test_groups_are_those_of_all_optimizers_that_live():
    session = state()
    model, _ = follow(session)
    other = torch.optim.SGD([{"params": [torch.zeros(1)], "name": "sky"}], lr=1.0)
    session.optimizers[model] += [weakref.ref(other)]
    assert [name for name, _ in session.groups(model)] == ["xyz", "o", "sky"]
    assert session.groups(model)[2][1] is other.param_groups[0]
    session.adapter.group_name = lambda owner, group: owner is model
    assert {named for named, _ in session.groups(model)} == {True}
    del session.adapter.group_name
    del other
    gc.collect()
    assert [name for name, _ in session.groups(model)] == ["xyz", "o"]
    assert session.groups(Model(2)) == []


def test_the_model_of_reports_is_the_one_that_was_followed_last():
    session = state()
    model, known = follow(session)
    session.follow(model, known)
    assert session.last() is model
    assert session.last_state is known


def saved(session):
    return [about["path"] for name, about in session.plugins.told if name == "fragprune_saved"]


def test_thresholds_are_saved_with_who_wrote_them(tmp_path):
    session = state(settings=Settings(iterations=7))
    model, known = follow(session)
    path = tmp_path / "a.ply"
    path.write_text("a model")
    session.save(model, path)
    store, info = sidecar.load(path, 6)
    assert torch.equal(store.logits, known.store.logits)
    assert (info.adapter, info.host_commit) == ("three-lines", "abc")
    assert info.settings == session.settings.as_dict()
    assert saved(session) == [sidecar.path_beside(path)]


def test_a_new_model_and_its_thresholds_replace_the_old_ones_together(tmp_path):
    session = state()
    model, known = follow(session)
    path = tmp_path / "a.ply"
    path.write_text("an old model")
    sidecar.save(path, ThresholdStore(2))
    with staging(path) as folder:
        (folder / "a.ply").write_text("a new model")
        session.save(model, path, folder / "a.ply")
    assert path.read_text() == "a new model"
    store, info = sidecar.load(path, 6)
    assert torch.equal(store.logits, known.store.logits)
    assert (info.adapter, info.host_commit) == ("three-lines", "abc")
    assert info.settings == session.settings.as_dict()


@pytest.mark.parametrize("staged", [False, True])
@pytest.mark.parametrize("still", [False, True])
def test_neutral_thresholds_are_saved_in_stage_two_only(tmp_path, staged, still):
    session = state(freeze=still)
    model, known = follow(session)
    known.store.replace(6)
    path = tmp_path / "a.ply"
    path.write_text("an old model")
    sidecar.save(path, ThresholdStore(2))
    if staged:
        with staging(path) as folder:
            (folder / "a.ply").write_text("a new model")
            session.save(model, path, folder / "a.ply")
        assert path.read_text() == "a new model"
    else:
        session.save(model, path)
    assert sidecar.path_beside(path).exists() is still
    assert len(saved(session)) == still
    if still:
        assert sidecar.load(path, 6)[0].logits.tolist() == [NEUTRAL_LOGIT] * 6


def test_saving_without_a_sidecar_to_remove_is_no_error(tmp_path):
    session = state(freeze=False)
    model, known = follow(session)
    known.store.replace(6)
    session.save(model, tmp_path / "a.ply")
    assert list(tmp_path.iterdir()) == []


def test_a_model_that_the_session_does_not_know_is_not_saved(tmp_path):
    with pytest.raises(SessionError, match="without thresholds") as caught:
        state().save(Model(2), tmp_path / "a.ply")
    assert caught.value.where == "save()"


def test_rows_that_changed_unseen_are_noticed_before_anything_is_saved(tmp_path):
    session = state()
    model, _ = follow(session)
    model.xyz = torch.nn.Parameter(torch.zeros(4, 3))
    with pytest.raises(AlignmentError, match="4 Gaussians") as caught:
        session.save(model, tmp_path / "a.ply")
    assert caught.value.where == str(tmp_path / "a.ply")
    assert caught.value.expected == "6, one per threshold"
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize("warming", [True, False, None])
def test_a_model_saved_before_thresholds_open_is_warned_of(tmp_path, caplog, warming):
    session = state()
    model, known = follow(session)
    known.stage = None if warming is None else SimpleNamespace(warming_up=warming, steps=3)
    path = tmp_path / "a.ply"
    path.write_text("a model")
    with caplog.at_level(logging.WARNING, "fragprune"):
        session.save(model, path)
    assert [str(path) in each.message for each in caplog.records] == [True] * bool(warming)
    assert all(f"step 3 of {session.settings.iterations}" in e.message for e in caplog.records)


def test_a_loaded_model_has_the_thresholds_beside_its_file(tmp_path):
    session = state()
    path = tmp_path / "a.ply"
    path.write_text("a model")
    sidecar.save(path, ThresholdStore.from_falloff(torch.tensor([0.1, 0.2])))
    model = Model(2)
    session.load(model, path)
    known = session.models[model]
    assert torch.allclose(known.store.values, torch.tensor([0.1, 0.2]))
    assert known.loaded() is model.xyz
    assert (session.last(), session.last_state) == (model, known)
    assert session.plugins.told == [("fragprune_attached", {"model": model, "store": known.store})]
    with pytest.raises(SidecarError, match=r"2 Gaussian\(s\)"):
        session.load(Model(3), path)


def test_thresholds_of_a_hosts_own_checkpoint_are_taken_up_as_they_were_saved():
    saved = ThresholdStore.from_falloff(torch.tensor([0.1, 0.2]))
    session, model = state(), Model(2)
    session.take_up(model, saved.state_dict())
    taken = session.models[model]
    assert torch.equal(taken.store.logits, saved.logits)
    assert taken.loaded() is session.adapter.means(model)
    assert session.last() is model


def test_thresholds_of_another_number_of_gaussians_are_not_taken_up():
    session, model = state(), Model(3)
    with pytest.raises(AlignmentError, match="saved thresholds"):
        session.take_up(model, ThresholdStore(2).state_dict())
    assert model not in session.models
