"""What a session does with a host's rows, handler by handler. Whole hosts: tests/conformance."""

import contextlib

import pytest
import torch
from core.sessions import Model, Role, call, follow, state

from fragprune_plugins.adapting import AlignmentError, RowTrace
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


def rearrange(session, model, trace, rows=None):
    events = []

    @contextlib.contextmanager
    def tracing(_):
        events.append("begun")
        yield trace
        events.append("over")

    def host():
        events.append("host")
        if rows is not None:
            model.xyz = torch.nn.Parameter(model.xyz.detach()[rows])
        return "rearranged"

    result = OF_MODELS[Role.REARRANGE](session, call(model, Role.REARRANGE, host, how=tracing))
    return result, events


@pytest.mark.parametrize("trace", [RowTrace(), RowTrace(torch.tensor([0])), RowTrace(None, None)])
def test_an_operation_that_did_nothing_changes_nothing(session, trace):
    model, known = follow(session)
    known.views[3] = print
    assert rearrange(session, model, trace)[0] == "rearranged"
    assert torch.equal(known.store.logits, LOGITS)
    assert (list(known.views), told(session)) == ([3], [])


def test_thresholds_follow_their_rows_to_new_places_and_observers_are_told(session):
    model, known = follow(session)
    rows = torch.tensor([4, 0, 2])
    rearrange(session, model, RowTrace(rows, torch.zeros(3, dtype=torch.bool)), rows)
    assert torch.equal(known.store.logits, LOGITS[rows])
    assert told(session) == [("rearrange", 6, 3)]


def test_an_operation_whose_rows_nobody_traced_is_refused(session):
    model, _ = follow(session)
    with pytest.raises(AlignmentError, match="host:f: 4 Gaussians"):
        rearrange(session, model, RowTrace(), torch.arange(4))


@pytest.mark.parametrize("role", [Role.REARRANGE, Role.STILL])
def test_a_frozen_model_stands_still(role):
    frozen = state(freeze=True)
    model, known = follow(frozen)
    ran = []
    seam = call(model, role, ran.append, torch.ones(6, dtype=torch.bool), how=lambda _: "instead")
    assert OF_MODELS[role](frozen, seam) == ("instead" if role is Role.STILL else None)
    assert ran == []
    assert torch.equal(known.store.logits, LOGITS)
