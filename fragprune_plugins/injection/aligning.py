"""Rows of a model come, go and move: its thresholds follow, or it is an error."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any

import torch
from torch import Tensor

from fragprune_plugins.errors import AlignmentError
from fragprune_plugins.hosts.seams import Role, SeamCall
from fragprune_plugins.injection.state import SessionState


def on_parents(session: SessionState, call: SeamCall) -> Any:
    """Know the parents before the host copies them."""
    state = session.models.get(call.model)
    if state is None:
        return call.run()
    state.pending_parents = call.how()
    try:
        result = call.run()
        left = 0 if state.pending_parents is None else len(state.pending_parents)
        expect_children(call, f"{left} selected parents without a child", not left)
        return result
    finally:
        state.pending_parents = None


def on_append(session: SessionState, call: SeamCall) -> Any:
    """New rows take their parents' thresholds, or start neutral."""
    state = session.models.get(call.model)
    if state is None:
        return call.run()
    tensors = call.first
    count, parents = len(next(iter(tensors.values()))), state.pending_parents
    if parents is not None:
        parents, rest = parents[:count], parents[count:]
        state.pending_parents = rest if len(rest) else None  # of what is appended next
        copies = len(parents) == count and are_copies(session, call.model, tensors, parents)
        what = f"{count} new rows that are not copies of the selected parents"
        expect_children(call, what, copies)
    result = call.run()
    before = len(state.store)
    state.store.append(count, parents)
    session.changed(state.store, "append", before)
    return result


def expect_children(call: SeamCall, found: str, right: bool) -> None:
    """Raise AlignmentError unless new rows are what was expected."""
    if not right:
        raise AlignmentError(
            str(call.seam),
            found,
            "one child per selected parent and repeat, in the host's order",
            "Report this with the host's commit: its densification differs.",
        )


def are_copies(
    session: SessionState, model: Any, tensors: Mapping[str, Tensor], parents: Tensor
) -> bool:
    """Whether new rows, by param group, have the bits of their parents that children inherit."""
    known = {name: group["params"][0] for name, group in session.groups(model)}
    return all(torch.equal(tensors[n], known[n][parents]) for n in session.adapter.inherited)


def on_choice(session: SessionState, call: SeamCall) -> Any:
    """Keep the rows that the host drew as parents."""
    result = call.run()
    state = session.models.get(call.model)
    if state is not None:
        chosen = call.first
        state.pending_parents = chosen.detach().clone()
    return result


def on_copy(session: SessionState, call: SeamCall) -> Any:
    """Rows overwritten by others take those rows' thresholds; not in stage 2."""
    if session.standing_still(call.model):
        return None
    state = session.models.get(call.model)
    if state is None:
        return call.run()
    mask = call.first
    target = mask.nonzero()[:, 0]
    state.pending_parents = None
    try:
        result = call.run()
    finally:
        source, state.pending_parents = state.pending_parents, None
    if source is None:  # nothing to overwrite, or nothing to copy
        return result
    groups = [(name, group) for name, group in session.groups(call.model) if name]
    rows = {name: group["params"][0].detach()[target] for name, group in groups}
    if len(source) != len(target) or not are_copies(session, call.model, rows, source):
        raise AlignmentError(
            str(call.seam),
            f"{len(target)} overwritten rows that are not copies of the {len(source)} drawn",
            "one copy per overwritten row, in the host's order",
            "Report this with the host's commit: its relocation differs.",
        )
    state.store.copy(source, target)
    session.changed(state.store, "copy", len(state.store))
    return result


def on_forget(session: SessionState, call: SeamCall) -> Any:
    """Zero the moments of rows whose moments the host zeroed."""
    result = call.run()
    state = session.models.get(call.model)
    if state is not None:
        state.store.forget(call.first)
    return result


def on_keep(session: SessionState, call: SeamCall) -> Any:
    """Remove what the host removed."""
    result = call.run()
    state = session.models.get(call.model)
    if state is not None:
        mask = call.first
        before = len(state.store)
        state.store.keep(mask)
        session.changed(state.store, "keep", before)
    return result


def on_rearrange(session: SessionState, call: SeamCall) -> Any:
    """Follow rows through an operation that keeps, copies and appends at once."""
    if session.standing_still(call.model):
        return None
    state = session.models.get(call.model)
    if state is None:
        return call.run()
    with call.how() as trace:
        result = call.run()
    if trace.origins is not None and trace.fresh is not None:
        before = len(state.store)
        state.store.rearrange(trace.origins, trace.fresh)
        state.views.clear()  # their calls may hold tensors of the rows before
        session.changed(state.store, "rearrange", before)
    session.expect_rows(call.model, state, str(call.seam))
    return result


def on_still(session: SessionState, call: SeamCall) -> Any:
    """Operations that would move a frozen model do not run in stage 2."""
    if session.standing_still(call.model):
        return call.how()
    return call.run()


OF_MODELS: dict[Role, Callable[..., Any]] = {
    Role.PARENTS: on_parents,
    Role.KEEP: on_keep,
    Role.APPEND: on_append,
    Role.CHOICE: on_choice,
    Role.COPY: on_copy,
    Role.REARRANGE: on_rearrange,
    Role.FORGET: on_forget,
    Role.STILL: on_still,
}
