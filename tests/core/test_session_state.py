"""What all handlers of a session share, and what each does with a host's rows."""

import logging
import re
from types import SimpleNamespace

import pytest
import torch
from core.sessions import Model, Role, call, follow, state

from fragprune_plugins.adapting import ParamGroup
from fragprune_plugins.constants import NEUTRAL_LOGIT
from fragprune_plugins.errors import AlignmentError, SessionError
from fragprune_plugins.files import sidecar
from fragprune_plugins.files.atomic import staging
from fragprune_plugins.injection import saving
from fragprune_plugins.injection import state as module
from fragprune_plugins.injection.session import OF_MODELS
from fragprune_plugins.learning.thresholds import ThresholdStore

CPU = torch.device("cpu")


@pytest.mark.parametrize(("name", "warned"), [("cpu", False), ("reference", True)])
def test_an_engine_is_opened_once_a_device_and_a_slow_one_told(monkeypatch, caplog, name, warned):
    asked = []
    engine = SimpleNamespace(name=name)
    monkeypatch.setattr(module, "engine_for", lambda *words: asked.append(words) or engine)
    session = state(engine="auto")
    devices = CPU, torch.device("xpu:1")
    with caplog.at_level(logging.WARNING, "fragprune"):
        assert all(session.engine(device) is engine for device in 2 * devices)
    assert asked == [("auto", device, session.plugins) for device in devices]
    said = " ".join(each.message for each in caplog.records)
    assert [said.count(f"draws on {device}:") for device in devices] == [int(warned)] * 2


class OnGpu(torch.Tensor):
    """NumPy sees its numbers once they are on the CPU."""

    def cpu(self):
        return self.as_subclass(torch.Tensor)

    def __array__(self, *_):
        raise TypeError("can't convert cuda:0 device type tensor to numpy")


@pytest.mark.parametrize("diverged", [False, True])
def test_a_copy_that_a_host_takes_from_a_gpu_to_save_it_is_its_models(diverged):
    """``{name: each.cpu()}``; a learner that diverged is refused, and not taken for another."""
    session = state()
    (_, _), (other, known), copy = follow(session), follow(session), Model(6)
    session.adapter.opacities = lambda model: model.opacity
    with torch.no_grad():
        other.xyz += torch.nan if diverged else 1
        copy.xyz = other.xyz.detach().clone()
        other.xyz = other.xyz.detach().as_subclass(OnGpu)
        asked = SimpleNamespace(model=copy, seam="save")
        assert saving.learner(session, asked) == (other, known)
        copy.opacity += 1
        assert saving.learner(session, asked) == (copy, None)


def saved(session):
    return [about["path"] for name, about in session.plugins.told if name == "fragprune_saved"]


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


def test_a_model_that_the_session_does_not_know_is_not_saved(tmp_path):
    with pytest.raises(SessionError, match=r"save\(\): a model without thresholds"):
        state().save(Model(2), tmp_path / "a.ply")


def test_rows_that_changed_unseen_are_noticed_before_anything_is_saved(tmp_path):
    session = state()
    model, _ = follow(session)
    model.xyz = torch.nn.Parameter(torch.zeros(4, 3))
    says = f"{tmp_path / 'a.ply'}: 4 Gaussians; expected 6, one per threshold"
    with pytest.raises(AlignmentError, match=re.escape(says)):
        session.save(model, tmp_path / "a.ply")
    assert list(tmp_path.iterdir()) == []


def test_what_a_host_writes_beside_its_model_follows_it_each_time_folders_too(tmp_path):
    session = state()
    model, _ = follow(session)
    path = tmp_path / "out" / "a.ply"
    for content in ("first", "second"):

        def write(path, content=content):
            (path.parent / "networks").mkdir()
            for each in (path, path.with_name("a.npz"), path.parent / "networks" / "colour.pt"):
                each.write_text(content)

        saving.on_save(session, call(model, Role.SAVE, write, path, how=lambda call: call.first))
        for each in ("a.ply", "a.npz", "networks/colour.pt"):
            assert (path.parent / each).read_text() == content
        assert sidecar.belongs(path)


@pytest.mark.parametrize("learn", [True, False])
def test_the_sidecar_of_an_earlier_file_goes_once_a_model_without_thresholds_is_written(
    tmp_path, learn
):
    """While thresholds learn, a host may write a copy of the model: whoever reads it is told."""
    path = tmp_path / "a.ply"
    path.write_text("earlier")
    sidecar.save(path, ThresholdStore(0))

    def save(write):
        request = call(Model(3), Role.SAVE, write, path, how=lambda call: call.first)
        saving.on_save(state(learn=learn), request)

    with pytest.raises(AttributeError):
        save(lambda path: path.full())
    assert sidecar.belongs(path)
    save(lambda path: path.write_text("new"))
    assert bool(sidecar.find(path)) == learn


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


def test_a_checkpoint_in_memory_can_be_restored_again():
    """A host that goes back to its last good state may do so twice."""
    session = state()
    model, known = follow(session)
    session.rates[model] = {}
    learned = known.store.logits.detach().clone()
    kept = call(model, Role.CAPTURE, lambda: (model.optimizer.state_dict(), 7))
    kept = saving.on_capture(session, kept)
    for _ in range(2):
        known.store.replace(6)  # as a new optimizer does
        restore = call(model, Role.RESTORE, lambda kept: None, kept, how=lambda call: call.first)
        saving.on_restore(session, restore)
        assert torch.equal(known.store.logits, learned)


LOGITS = -3 + torch.arange(6.0) / 8


@pytest.fixture
def session():
    return state(freeze=False)


def told(session):
    return [
        (about["change"].operation, about["change"].before, about["change"].after)
        for name, about in session.plugins.told
        if name == "fragprune_population_changed"
    ]


MOVED = {
    "copies, two of one row": ((4, 1, 5, 1), {}, (4, 1, 5, 1)),
    "one that is no copy": ((4, 1, 5), {"xyz": 1}, (4, None, 5)),
    "two that are no copies": ((4, 1, 5), {"xyz": 0, "o": 2}, (None, 1, None)),
    "none": ((), {}, ()),
}


@pytest.mark.parametrize("what", MOVED)
def test_new_rows_get_the_thresholds_of_those_whose_copies_they_are(session, what):
    model, known = follow(session)
    rows, moved, expected = MOVED[what]
    tensors = {name: each.detach()[list(rows)].clone() for name, each in model.rows().items()}
    for name, row in moved.items():
        tensors[name][row] += 1
    seam = call(model, Role.APPEND, lambda tensors: "appended", tensors)
    assert OF_MODELS[Role.APPEND](session, seam) == "appended"
    inherited = [NEUTRAL_LOGIT if each is None else float(LOGITS[each]) for each in expected]
    assert torch.equal(known.store.logits, torch.tensor([*LOGITS, *inherited]))


def test_of_equal_rows_the_first_is_the_parent(session):
    model, known = follow(session)
    with torch.no_grad():
        for each in model.rows().values():
            each[4] = each[1]
    tensors = {name: each.detach()[[1]] for name, each in model.rows().items()}
    OF_MODELS[Role.APPEND](session, call(model, Role.APPEND, lambda tensors: None, tensors))
    assert known.store.logits[6] == LOGITS[1]


@pytest.mark.parametrize("role", [Role.KEEP, Role.APPEND, Role.REARRANGE, Role.STILL])
def test_a_model_that_is_not_followed_is_the_hosts_own_business(session, role):
    seam = call(Model(3), role, lambda tensors: f"done with {tensors}", "these")
    assert OF_MODELS[role](session, seam) == "done with these"
    assert session.plugins.told == []


def rearranged(session, model, rows, moved=()):
    """The model's rows as they are in an operation that takes these, and moves those at places."""

    def host():
        (group, other) = model.optimizer.param_groups
        with torch.no_grad():
            model.xyz = torch.nn.Parameter(model.xyz[rows])
            model.opacity = torch.nn.Parameter(model.opacity[rows])
            model.opacity[list(moved)] += 0.25
        group["params"], other["params"] = [model.xyz], [model.opacity]
        return "rearranged"

    return OF_MODELS[Role.REARRANGE](session, call(model, Role.REARRANGE, host))


ARRANGED = {
    "kept elsewhere": ((4, 0, 2), (), "..."),
    "cloned": ((0, 1, 2, 3, 4, 5, 4), (), "......n"),
    "split: both children are moved": ((0, 1, 2, 3, 5, 4, 4), (5, 6), ".....nn"),
    "overwritten by a copy, its parent changed, too": ((0, 1, 5, 3, 4, 5), (2, 5), "..n..n"),
}


@pytest.mark.parametrize("what", ARRANGED)
def test_thresholds_follow_their_rows_to_new_places_and_observers_are_told(session, what):
    model, known = follow(session)
    session.adapter.groups = (ParamGroup("xyz", copied=True), ParamGroup("o"))
    rows, moved, fresh = ARRANGED[what]
    origins, new = torch.tensor(rows), torch.tensor([each == "n" for each in fresh])
    assert rearranged(session, model, origins, moved) == "rearranged"
    assert torch.equal(known.store.logits, LOGITS[origins])
    assert torch.equal(known.store.adam["exp_avg"], torch.where(new, 0.0, 1.0 + origins))
    assert told(session) == [("rearrange", 6, len(rows))]


def test_an_operation_that_did_nothing_changes_nothing(session):
    model, known = follow(session)
    known.views[3], before = print, known.store.logits
    assert rearranged(session, model, torch.arange(6)) == "rearranged"
    assert known.store.logits is before  # with its gradient
    assert (list(known.views), told(session)) == ([3], [])


def test_rows_that_no_known_optimizer_has_are_not_lost_silently(session):
    model, _ = follow(session)
    session.optimizers[model] = []
    with pytest.raises(AlignmentError, match="host:f: 3 Gaussians"):
        rearranged(session, model, torch.arange(3))


def test_of_neutral_thresholds_only_the_number_is_followed(session):
    model, known = follow(session)
    known.store.replace(6)
    rearranged(session, model, torch.tensor([1, 1, 3]), (0, 1))
    assert (len(known.store), known.store.neutral) == (3, True)


def test_a_row_that_is_no_copy_is_neutral(session):
    model, known = follow(session)
    session.adapter.groups = (ParamGroup("xyz"), ParamGroup("o", copied=True))
    rearranged(session, model, torch.tensor([0, 1]), (1,))
    assert known.store.logits.tolist() == [LOGITS[0], pytest.approx(NEUTRAL_LOGIT)]


@pytest.mark.parametrize("role", [Role.REARRANGE, Role.STILL])
def test_a_frozen_model_stands_still(role):
    frozen = state(freeze=True)
    model, known = follow(frozen)
    ran = []
    seam = call(model, role, ran.append, torch.ones(6, dtype=torch.bool), how=lambda _: "instead")
    assert OF_MODELS[role](frozen, seam) == ("instead" if role is Role.STILL else None)
    assert ran == []
    assert torch.equal(known.store.logits, LOGITS)
