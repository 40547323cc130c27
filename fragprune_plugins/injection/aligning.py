"""Rows of a model come, go and move: its thresholds follow, or it is an error."""

from __future__ import annotations

from collections.abc import Callable
from typing import TYPE_CHECKING, Any

from fragprune_plugins.errors import AlignmentError
from fragprune_plugins.hosts.seams import Role, Seam
from fragprune_plugins.injection.state import named

if TYPE_CHECKING:
    from fragprune_plugins.injection.session import Session


def on_parents(
    session: Session, seam: Seam, wrapped: Any, model: Any, args: Any, kwargs: Any
) -> Any:
    """Know the parents before the host copies them."""
    state = session.models.get(model)
    if state is None:
        return wrapped(*args, **kwargs)
    method = seam.attribute.split(".")[-1]
    arguments = named(wrapped, args, kwargs)
    state.pending_parents = session.adapter.parents(model, method, arguments)
    try:
        result = wrapped(*args, **kwargs)
        left = 0 if state.pending_parents is None else len(state.pending_parents)
        expect_children(session, seam, f"{left} selected parents without a child", not left)
        return result
    finally:
        state.pending_parents = None


def on_append(
    session: Session, seam: Seam, wrapped: Any, model: Any, args: Any, kwargs: Any
) -> Any:
    """New rows take their parents' thresholds, or start neutral."""
    state = session.models.get(model)
    if state is None:
        return wrapped(*args, **kwargs)
    tensors = named(wrapped, args, kwargs)[seam.needs[0]]
    count, parents = len(next(iter(tensors.values()))), state.pending_parents
    if parents is not None:
        parents, rest = parents[:count], parents[count:]
        state.pending_parents = rest if len(rest) else None  # of what is appended next
        copies = len(parents) == count and session.adapter.check_children(model, tensors, parents)
        what = f"{count} new rows that are not copies of the selected parents"
        expect_children(session, seam, what, copies)
    result = wrapped(*args, **kwargs)
    before = len(state.store)
    state.store.append(count, parents)
    session.changed(state.store, "append", before)
    return result


def expect_children(session: Session, seam: Seam, found: str, right: bool) -> None:
    """Raise AlignmentError unless new rows are what was expected."""
    if not right:
        raise AlignmentError(
            str(seam),
            found,
            "one child per selected parent and repeat, in the host's order",
            "Report this with the host's commit: its densification differs.",
        )


def on_choice(
    session: Session, seam: Seam, wrapped: Any, model: Any, args: Any, kwargs: Any
) -> Any:
    """Keep the rows that the host drew as parents."""
    result = wrapped(*args, **kwargs)
    state = session.models.get(model)
    if state is not None:
        chosen = named(wrapped, args, kwargs)[seam.needs[0]]
        state.pending_parents = chosen.detach().clone()
    return result


def on_copy(session: Session, seam: Seam, wrapped: Any, model: Any, args: Any, kwargs: Any) -> Any:
    """Rows overwritten by others take those rows' thresholds; not in stage 2."""
    if session.standing_still(model):
        return None
    state = session.models.get(model)
    if state is None:
        return wrapped(*args, **kwargs)
    mask = named(wrapped, args, kwargs)[seam.needs[0]]
    target = mask.nonzero()[:, 0]
    state.pending_parents = None
    try:
        result = wrapped(*args, **kwargs)
    finally:
        source, state.pending_parents = state.pending_parents, None
    if source is None:  # nothing to overwrite, or nothing to copy
        return result
    groups = [(name, group) for name, group in session.groups(model) if name]
    rows = {name: group["params"][0].detach()[target] for name, group in groups}
    if len(source) != len(target) or not session.adapter.check_children(model, rows, source):
        raise AlignmentError(
            str(seam),
            f"{len(target)} overwritten rows that are not copies of the {len(source)} drawn",
            "one copy per overwritten row, in the host's order",
            "Report this with the host's commit: its relocation differs.",
        )
    state.store.copy(source, target)
    session.changed(state.store, "copy", len(state.store))
    return result


def on_forget(
    session: Session, seam: Seam, wrapped: Any, model: Any, args: Any, kwargs: Any
) -> Any:
    """Zero the moments of rows whose moments the host zeroed."""
    result = wrapped(*args, **kwargs)
    state = session.models.get(model)
    if state is not None:
        state.store.forget(named(wrapped, args, kwargs)[seam.needs[0]])
    return result


def on_keep(session: Session, seam: Seam, wrapped: Any, model: Any, args: Any, kwargs: Any) -> Any:
    """Remove what the host removed."""
    result = wrapped(*args, **kwargs)
    state = session.models.get(model)
    if state is not None:
        mask = named(wrapped, args, kwargs)[seam.needs[0]]
        before = len(state.store)
        state.store.keep(mask)
        session.changed(state.store, "keep", before)
    return result


def on_rearrange(
    session: Session, seam: Seam, wrapped: Any, model: Any, args: Any, kwargs: Any
) -> Any:
    """Follow rows through an operation that keeps, copies and appends at once."""
    if session.standing_still(model):
        return None
    state = session.models.get(model)
    if state is None:
        return wrapped(*args, **kwargs)
    with session.adapter.tracing(model, wrapped, named(wrapped, args, kwargs)) as trace:
        result = wrapped(*args, **kwargs)
    if trace.origins is not None and trace.fresh is not None:
        before = len(state.store)
        state.store.rearrange(trace.origins, trace.fresh)
        state.views.clear()  # their calls may hold tensors of the rows before
        session.changed(state.store, "rearrange", before)
    session.expect_rows(model, state, str(seam))
    return result


def on_still(session: Session, seam: Seam, wrapped: Any, model: Any, args: Any, kwargs: Any) -> Any:
    """Operations that would move a frozen model do not run in stage 2."""
    if session.standing_still(model):
        return session.adapter.stand_still(wrapped, named(wrapped, args, kwargs))
    return wrapped(*args, **kwargs)


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
