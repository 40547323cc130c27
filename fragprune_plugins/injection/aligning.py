"""Keeps thresholds aligned with rows that the host adds, removes and moves."""

from __future__ import annotations

from typing import Any

import torch

from fragprune_plugins.errors import AlignmentError
from fragprune_plugins.hosts.seams import SeamCall
from fragprune_plugins.injection.state import SessionState


def on_parents(session: SessionState, call: SeamCall) -> Any:
    """Note the parents before the host copies them."""
    state = session.models.get(call.model)
    if state is None:
        return call.run()
    state.pending_parents = call.how()
    try:
        result = call.run()
        if state.pending_parents is not None:
            left = len(state.pending_parents)
            expect_children(call, f"{left} selected parents without a child", not left)
        return result
    finally:
        state.pending_parents = None


def on_append(session: SessionState, call: SeamCall) -> Any:
    """Append thresholds for new rows: those of their parents, whose copies they are, or neutral."""
    state = session.models.get(call.model)
    if state is None:
        return call.run()
    tensors = call.first
    count, parents = len(next(iter(tensors.values()))), state.pending_parents
    if parents is not None:
        parents, rest = parents[:count], parents[count:]
        state.pending_parents = rest if len(rest) else None  # parents of the next append
        known = {name: group["params"][0] for name, group in session.groups(call.model)}
        copied = [group.name for group in session.adapter.groups if group.copied]
        copies = len(parents) == count and all(
            torch.equal(tensors[name], known[name][parents]) for name in copied
        )
        what = f"{count} new rows that are not copies of the selected parents"
        expect_children(call, what, copies)
    result = call.run()
    with session.changing(state.store, "append"):
        state.store.append(count, parents)
    return result


def expect_children(call: SeamCall, found: str, right: bool) -> None:
    """Raise AlignmentError unless new rows are ``right``, one child per parent and repeat."""
    if not right:
        expected = "one child per selected parent and repeat, in the host's order"
        remedy = "Report this with the host's commit: its densification differs."
        raise AlignmentError(str(call.seam), found, expected, remedy)


def on_keep(session: SessionState, call: SeamCall) -> Any:
    """Remove the thresholds of rows that the host removed."""
    result = call.run()
    state = session.models.get(call.model)
    if state is not None:
        with session.changing(state.store, "keep"):
            state.store.keep(call.first)
    return result


def on_rearrange(session: SessionState, call: SeamCall) -> Any:
    """Follow rows through one operation that keeps, copies and appends. In stage 2 nothing runs."""
    if session.standing_still(call.model):
        return None
    state = session.models.get(call.model)
    if state is None:
        return call.run()
    with call.how() as trace:
        result = call.run()
    if trace.origins is not None and trace.fresh is not None:
        with session.changing(state.store, "rearrange"):
            state.store.rearrange(trace.origins, trace.fresh)
            state.views.clear()  # their calls may hold tensors of the old rows
    session.expect_rows(call.model, state, str(call.seam))
    return result


def on_still(session: SessionState, call: SeamCall) -> Any:
    """Skip an operation that would move a frozen model in stage 2."""
    if session.standing_still(call.model):
        return call.how()
    return call.run()
