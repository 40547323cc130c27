"""What a session does with a host's rows, handler by handler. Whole hosts: tests/conformance."""

import contextlib

import pytest
import torch
from core.sessions import Model, Role, call, follow, state

from fragprune_plugins.adapting import AlignmentError, RowTrace
from fragprune_plugins.injection.session import OF_MODELS

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


def append(session, model, rows, expected="appended"):
    """The host appends rows of the model by their numbers."""
    tensors = {name: each[rows].clone() for name, each in model.rows().items()}
    seam = call(model, Role.APPEND, lambda tensors: "appended", tensors)
    assert OF_MODELS[Role.APPEND](session, seam) == expected


def parents(session, model, rows, body):
    """Inside a call that chooses parents, ``body`` runs."""
    seam = call(model, Role.PARENTS, lambda: body() or "chosen", how=lambda _: rows)
    return OF_MODELS[Role.PARENTS](session, seam)


def test_a_parent_without_a_child_is_refused_with_their_number(session):
    model, known = follow(session)
    rows = torch.tensor([4, 1, 5])
    with pytest.raises(AlignmentError, match="host:f: 2 selected parents without a child"):
        parents(session, model, rows, lambda: append(session, model, rows[:1]))
    assert known.pending_parents is None


@pytest.mark.parametrize(
    ("rows", "moved"),
    [([4, 2, 5], ()), ([4, 1, 5, 3], ()), ([4, 1, 5], ["xyz"]), ([4, 1, 5], ["o"])],
)
def test_what_is_no_copy_of_its_parent_is_refused_before_the_host_appends(session, rows, moved):
    model, known = follow(session)
    appended = []

    def body():
        tensors = {name: each[rows] + (name in moved) for name, each in model.rows().items()}
        OF_MODELS[Role.APPEND](session, call(model, Role.APPEND, appended.append, tensors))

    with pytest.raises(AlignmentError, match=f"{len(rows)} new rows that are not copies"):
        parents(session, model, torch.tensor([4, 1, 5]), body)
    assert appended == []
    assert len(known.store) == 6
    assert known.pending_parents is None


@pytest.mark.parametrize("role", [Role.PARENTS, Role.KEEP, Role.APPEND, Role.REARRANGE, Role.STILL])
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
