"""Keeps thresholds aligned with rows that the host adds, removes and moves."""

from __future__ import annotations

from typing import Any

from fragprune_plugins.hosts.seams import SeamCall
from fragprune_plugins.injection.state import SessionState
from fragprune_plugins.learning.thresholds import copies


def on_append(session: SessionState, call: SeamCall) -> Any:
    """Append thresholds for new rows: those of the rows whose copies they are, or neutral ones."""
    state = session.models.get(call.model)
    if state is None:
        return call.run()
    new = call.first
    copied = [group.name for group in session.adapter.groups if group.copied and group.name in new]
    parents = None
    if copied and not state.store.neutral:
        own = {name: group["params"][0] for name, group in session.groups(call.model)}
        parents = copies(*([rows[name] for name in copied] for rows in (own, new)))
    result = call.run()
    with session.changing(state.store, "append"):
        state.store.append(len(next(iter(new.values()))), parents)
    return result


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
