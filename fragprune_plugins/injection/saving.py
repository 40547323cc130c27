"""Thresholds go where the host's files go: beside its models, inside its checkpoints."""

from __future__ import annotations

import logging
import weakref
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor

from fragprune_plugins.errors import AlignmentError
from fragprune_plugins.hosts.adapter import CHECKPOINT_KEY
from fragprune_plugins.hosts.seams import Role, SeamCall
from fragprune_plugins.injection.state import ModelState, SessionState
from fragprune_plugins.learning.thresholds import ThresholdStore
from fragprune_plugins.plugins import hookspecs
from fragprune_plugins.storage import sidecar

log = logging.getLogger("fragprune")


def on_save(session: SessionState, call: SeamCall) -> Any:
    """Thresholds beside the file that the host wrote; nothing is written that is not finite."""
    check_learned(session, call.model)
    result = call.run()
    if call.model in session.models and call.first is not None:
        session.save(call.model, Path(call.how(call.first)))
    return result


def check_learned(session: SessionState, model: Any) -> None:
    """Raise DivergedError where a model that learns is not finite: its host is about to save."""
    state = session.models.get(model)
    if state is not None and state.stage is not None and state.stage.plan is not None:
        state.stage.check()


def on_load(session: SessionState, call: SeamCall) -> Any:
    """Thresholds from beside the file that the host read."""
    result = call.run()
    path = Path(call.how(call.first))
    if sidecar.lies_beside(path):
        session.load(call.model, path)
    else:
        session.models.pop(call.model, None)  # another population: what we knew is not about it
    return result


def on_pack(session: SessionState, call: SeamCall) -> Any:
    """Thresholds beside a file that holds the Gaussians in an order of its own."""
    result = call.run()
    packed = call.how()
    model = session.last() if session.last else None
    state = session.models.get(model) if model is not None else None
    if packed is None or state is None or state.store.neutral:
        return result
    path, means = packed
    rows = rows_of(means, session.adapter.means(model), str(call.seam))
    store = ThresholdStore(0)
    store.load_state_dict(state.store.state_dict())
    store.rearrange(rows, torch.zeros(len(rows), dtype=torch.bool))
    session.write_sidecar(path, store)
    return result


def on_unpack(session: SessionState, call: SeamCall) -> Any:
    """Keep the thresholds of an unpacked file for the model that will be made of it."""
    result = call.run()
    packed = call.how()
    if packed is not None and sidecar.path_beside(packed[0]).exists():
        file, means = packed
        session.unpacked = means, sidecar.load(file, len(means))[0]
    return result


def adopt(session: SessionState, model: Any, expected: Tensor, store: ThresholdStore) -> None:
    """Thresholds of an unpacked file go to the model made of it, which is drawn next."""
    means = session.adapter.means(model)
    if not torch.equal(means.detach().cpu(), expected):
        raise AlignmentError(
            f"{session.adapter.name}: unpacked model",
            f"{len(means)} Gaussians that are not the unpacked file's",
            f"its {len(expected)}, in its order",
            "Report this with the host's commit: it draws another model after unpacking.",
        )
    placed = ThresholdStore(0, means.device)
    placed.load_state_dict(store.state_dict())
    session.models[model] = ModelState(placed, loaded=weakref.ref(means))
    session.follow(model, session.models[model])
    session.plugins.tell(hookspecs.fragprune_attached, model=model, store=placed)
    session.unpacked = None


def on_capture(session: SessionState, call: SeamCall) -> Any:
    """Thresholds inside the host's checkpoint; in stage 2 always, so that it is known for one."""
    model = call.model
    check_learned(session, model)
    result = call.run()
    state = session.models.get(model)
    if state is not None and (session.standing_still(model) or not state.store.neutral):
        session.expect_rows(model, state, str(call.seam))
        session.adapter.checkpoint_state(result)[CHECKPOINT_KEY] = state.store.state_dict()
    return result


def on_restore(session: SessionState, call: SeamCall) -> Any:
    """Thresholds out of the host's checkpoint."""
    model, capture = call.model, call.how(call.first)
    saved = session.adapter.checkpoint_state(capture).pop(CHECKPOINT_KEY, None)
    result = call.run(**{call.seam.needs[0]: capture})
    revive(session, model)
    state = session.models.get(model)
    if saved is not None:
        if state is None:
            device = session.adapter.means(model).device
            state = session.models[model] = ModelState(ThresholdStore(0, device))
        state.store.load_state_dict(saved)
        session.expect_rows(model, state, str(call.seam))
    return result


def revive(session: SessionState, model: Any) -> None:
    """Let a restored model train as the host sets it up, where its checkpoint would not.

    What version 0.1 froze it left frozen, in its checkpoints too, and at the rates of stage 2. A
    checkpoint that was made of a PLY has no rates.
    """
    groups = [(name, group) for name, group in session.groups(model) if name]
    names, adapter = {name for name, _ in groups}, session.adapter
    asleep = {n for n, g in groups if not any(each.requires_grad for each in g["params"])}
    trained = [adapter.trained_groups(train) for train in ("opacity", "appearance")]
    frozen = bool(asleep) and asleep in [names - each for each in trained if each is not None]
    if not frozen and any(group["lr"] for _, group in groups):
        return
    for name, group in groups:
        group["lr"] = session.rates[model].get(name, group["lr"])
        for parameter in group["params"] if frozen else ():
            parameter.requires_grad_(True)
    if frozen:
        log.warning(
            "%s: the checkpoint is of a stage 2 of fragprune 0.1, which left %s unable to train; "
            "they can again",
            adapter.name,
            ", ".join(sorted(asleep)),
        )


def rows_of(means: Tensor, among: Tensor, where: str) -> Tensor:
    """(M,) for each mean (M, 3) the first row among (N, 3) with the same bits."""
    known, wanted = among.detach().cpu().numpy(), means.numpy()
    both = np.concatenate([known, wanted])
    _, first, which = np.unique(both, axis=0, return_index=True, return_inverse=True)
    rows = first[which.reshape(-1)[len(known) :]]
    if (rows >= len(known)).any():
        raise AlignmentError(
            where,
            f"{int((rows >= len(known)).sum())} of {len(wanted)} positions that no Gaussian has",
            f"positions of the {len(known)} Gaussians",
            "Report this with the host's commit: it packs another model.",
        )
    return torch.from_numpy(rows)


OF_CALLS: dict[Role, Callable[..., Any]] = {
    Role.PACK: on_pack,
    Role.UNPACK: on_unpack,
}


OF_MODELS: dict[Role, Callable[..., Any]] = {
    Role.SAVE: on_save,
    Role.LOAD: on_load,
    Role.CAPTURE: on_capture,
    Role.RESTORE: on_restore,
}
