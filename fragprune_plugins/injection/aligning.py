"""Keeps thresholds aligned with rows that the host adds, removes and moves."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import torch
from torch import Tensor

from fragprune_plugins.hosts.seams import SeamCall
from fragprune_plugins.injection.state import SessionState
from fragprune_plugins.learning.thresholds import copies


def on_append(session: SessionState, call: SeamCall) -> Any:
    """Append thresholds for new rows: those of the rows whose copies they are, or neutral ones."""
    state = session.models.get(call.model)
    if state is None:
        return call.run()
    new, parents = call.first, None
    if copied := _copied(session, new) if not state.store.neutral else []:
        parents = copies(_copied(session, _rows(session, call)), copied)
    result = call.run()
    with session.changing(state.store, "append"):
        state.store.append(len(next(iter(new.values()))), parents)
    return result


def _copied(session: SessionState, rows: Mapping[str | None, Tensor]) -> list[Tensor]:
    """Of the values of rows, by group, those that children copy."""
    return [rows[each.name] for each in session.adapter.groups if each.copied and each.name in rows]


def on_keep(session: SessionState, call: SeamCall) -> Any:
    """Remove the thresholds of rows that the host removed."""
    result = call.run()
    state = session.models.get(call.model)
    if state is not None:
        with session.changing(state.store, "keep"):
            state.store.keep(call.first)
    return result


def on_rearrange(session: SessionState, call: SeamCall) -> Any:
    """Follow rows through one call that keeps, overwrites, copies, adds; none runs in stage 2."""
    if session.standing_still(call.model):
        return None
    state = session.models.get(call.model)
    if state is None:
        return call.run()
    before, result, after = _rows(session, call), call.run(), _rows(session, call)
    if not all(map(torch.equal, before.values(), after.values())):  # else gradients stay to be used
        with session.changing(state.store, "rearrange"):
            if state.store.neutral:
                state.store.replace(len(session.adapter.means(call.model)))
            else:
                parents = copies(_copied(session, before), _copied(session, after))
                same, now = (copies([*e.values()], [*after.values()]) for e in (before, after))
                fresh = (same < 0) | (now < torch.arange(len(now), device=now.device))
                state.store.rearrange(torch.where(same < 0, parents, same), fresh)
        state.views.clear()  # their calls may hold tensors of the old rows
    session.expect_rows(call.model, state, str(call.seam))
    return result


def held_rows(model: Any, count: int) -> list[tuple[dict[str, Any], str, Tensor]]:
    """What a model itself holds of this many rows: where, by which name, and the tensor."""
    places = [vars(model), *(vars(model).get(k, {}) for k in ("_parameters", "_buffers"))]
    every = ((held, name, each) for held in places for name, each in held.items())
    return [
        (held, name, each)
        for held, name, each in every
        if isinstance(each, Tensor) and each.shape[:1] == (count,)
    ]


def keep_rows(session: SessionState, model: Any, kept: Tensor) -> None:
    """Remove the Gaussians but for ``kept``, (N,) bool, between two steps of a training.

    Whatever has a row for each keeps a part: parameters, which are new ones, moments, statistics.
    """
    parts: dict[Tensor, Tensor] = {}
    for held, name, old in held_rows(model, len(kept)):
        if old not in parts:
            part, trains = old.detach()[kept], old.requires_grad and old.is_leaf
            known = isinstance(old, torch.nn.Parameter)
            parts[old] = torch.nn.Parameter(part, trains) if known else part.requires_grad_(trains)
        held[name] = parts[old]
    for optimizer in filter(None, (each() for each in session.optimizers[model])):
        for group in optimizer.param_groups:
            group["params"] = [parts.get(each, each) for each in group["params"]]
        for old in parts.keys() & optimizer.state.keys():
            moments = optimizer.state.pop(old)
            optimizer.state[parts[old]] = {
                name: each[kept] if getattr(each, "shape", ())[:1] == kept.shape else each
                for name, each in moments.items()
            }
    with session.changing(session.models[model].store, "keep"):
        session.models[model].store.keep(kept)


def _rows(session: SessionState, call: SeamCall) -> dict[str | None, Tensor]:
    """What tells a model's rows apart, by group: all values but colours that are not copied."""
    told = {each.name for each in session.adapter.groups if each.copied or not each.colour}
    groups = ((name, group["params"][0]) for name, group in session.groups(call.model))
    rows = call.how() or {name: each for name, each in groups if name in told}
    return {name: each.detach().clone() for name, each in rows.items()}


def on_still(session: SessionState, call: SeamCall) -> Any:
    """Skip an operation that would move a frozen model in stage 2."""
    if session.standing_still(call.model):
        return call.how()
    return call.run()
