"""What a session does with a host's rows, handler by handler. Whole hosts: tests/conformance."""

import pytest
import torch
from core.sessions import Model, Role, call, follow, state

from fragprune_plugins.adapting import AlignmentError, ParamGroup
from fragprune_plugins.injection.session import OF_MODELS
from fragprune_plugins.learning.thresholds import NEUTRAL_LOGIT

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
