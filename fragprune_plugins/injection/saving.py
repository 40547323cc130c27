"""Saves thresholds with the host's files: beside its models and inside its checkpoints."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor

from fragprune_plugins.errors import AlignmentError, log
from fragprune_plugins.files import sidecar
from fragprune_plugins.files.atomic import staging
from fragprune_plugins.hosts.adapter import CHECKPOINT_KEY, optimizer_state
from fragprune_plugins.hosts.seams import SeamCall
from fragprune_plugins.injection.state import ModelState, SessionState
from fragprune_plugins.learning.thresholds import ThresholdStore, copies


def on_save(session: SessionState, call: SeamCall) -> Any:
    """Have the host write its file aside, then put file and sidecar in place, both at once."""
    (model, state), file = learner(session, call), call.how(call.first)
    if file is None or state is None or hasattr(call.first, "flush"):  # an open file stays in place
        result = call.run()
        if file is not None and state is not None:
            call.first.flush()
            session.save(model, Path(file))
        elif file is not None and not session.learn:
            sidecar.path_beside(Path(file)).unlink(missing_ok=True)
        elif state is not None and state.store.cuts:
            log.warning("%s: without cutoffs: pass the path of a file", call.seam)
        return result
    path = Path(file)
    with staging(path) as folder:
        aside = type(call.first)(folder / Path(call.first).name)
        result = call.run(**{call.seam.needs[0]: aside})
        for other in [f for f in folder.rglob("*") if f.is_file() and f != folder / path.name]:
            beside = path.parent / other.relative_to(folder)
            beside.parent.mkdir(parents=True, exist_ok=True)
            other.replace(beside)
        session.save(model, path, folder / path.name)
    return result


def learner(session: SessionState, call: SeamCall) -> tuple[Any, ModelState | None]:
    """The model that is saved, or that of which it is an exact copy; DivergedError if it is NaN."""
    model = call.model
    if session.models and model not in session.models:
        of = session.adapter.means, session.adapter.opacities
        for known in session.models:
            pairs = ((each(known).detach().cpu(), each(model).detach().cpu()) for each in of)
            if all(np.array_equal(a.float(), b.float(), equal_nan=True) for a, b in pairs):
                model = known
                break
        else:
            log.warning("%s: without cutoffs: no learning model has these Gaussians", call.seam)
    state = session.models.get(model)
    if state is not None and state.stage is not None and state.stage.plan is not None:
        state.stage.check()
    return model, state


def on_load(session: SessionState, call: SeamCall) -> Any:
    """Load the thresholds of the file that the host read, if it has some."""
    result = call.run()
    path = Path(call.how(call.first))
    if not session.load(call.model, path):
        session.models.pop(call.model, None)  # the model now has other Gaussians
        others = [each for each in path.parent.parent.glob(f"*/{path.name}") if sidecar.find(each)]
        if others and not session.learn:  # a render.py --iteration 30000
            newest = max(others, key=lambda each: each.stat().st_mtime)
            log.warning("%s has no cutoffs. %s has, the pruned model.", path, newest)
    return result


def on_pack(session: SessionState, call: SeamCall) -> Any:
    """Write the sidecar of a packed file, with rows in the file's order."""
    result, packed = call.run(), call.how()
    if packed is None:
        return result
    (path, rows), store = packed, None
    model = session.last() if session.last else None
    state = session.models.get(model) if model is not None else None
    if state is not None and state.store.cuts:
        if rows.ndim > 1:
            rows = rows_of(rows, session.adapter.means(model), str(call.seam))
        store = state.store.clone("cpu")
        store.rearrange(rows, torch.zeros(len(rows), dtype=torch.bool))
    session.write_sidecar(path, store)
    return result


def on_unpack(session: SessionState, call: SeamCall) -> Any:
    """Keep the thresholds of an unpacked file until its model exists."""
    result = call.run()
    if (packed := call.how()) is not None and sidecar.find(packed[0]):
        file, means = packed
        session.unpacked = means, sidecar.load(file, len(means))[0]
    return result


def attach_file(session: SessionState, model: Any, expected: Tensor, store: ThresholdStore) -> None:
    """Attach thresholds of an unpacked file, of means ``expected`` (N, 3), to the model drawn next.

    A model that has thresholds takes these if it has the file's Gaussians: the host resumes it.
    If not, they wait for another model.
    """
    means, known = session.adapter.means(model), session.models.get(model)
    parts = slice(1), slice(None)  # the first row tells most others apart
    same = all(torch.equal(means.detach()[part].cpu(), expected[part]) for part in parts)
    if known is not None and not same:
        return
    if not same:
        found = f"{len(means)} Gaussians that differ from the unpacked file's"
        said = f"the file's {len(expected)} Gaussians in its order"
        remedy = "Report this with the host's commit: it draws another model after unpacking."
        raise AlignmentError(f"{session.adapter.name}: unpacked model", found, said, remedy)
    take = partial(session.take_up, model) if known is None else known.store.load_state_dict
    take(store.state_dict())
    session.unpacked = None


def on_capture(session: SessionState, call: SeamCall) -> Any:
    """Put thresholds into the host's checkpoint; in stage 2 neutral ones too, as its mark."""
    model, state = learner(session, call)
    result, session.held = call.run(), None
    if state is not None and (session.standing_still(model) or state.store.cuts):
        session.expect_rows(model, state, str(call.seam))
        held = optimizer_state(result, f"{session.adapter.name}: checkpoint")
        held[CHECKPOINT_KEY] = state.store.state_dict() | session.midway
    return result


def on_restore(session: SessionState, call: SeamCall) -> Any:
    """Take up the thresholds in the host's checkpoint, and let the host restore the rest."""
    model, capture = call.model, call.how(call.first)
    held = optimizer_state(capture, f"{session.adapter.name}: checkpoint")
    saved = held.get(CHECKPOINT_KEY)  # it stays: a host may restore the same one again
    capture = brought(capture, session.adapter.means(model).device)
    result = call.run(**{call.seam.needs[0]: capture})
    restore_rates(session, model)
    if saved is not None:
        device = session.adapter.means(model).device
        state = session.models.setdefault(model, ModelState(ThresholdStore(0, device)))
        state.store.load_state_dict(saved)
        session.expect_rows(model, state, str(call.seam))
    return result


def brought(capture: Any, device: torch.device) -> Any:
    """What a checkpoint holds, on its model's GPU, if none of it is there: ours are on the CPU.

    Scalars stay: Adam counts its steps on the CPU.
    """
    if device.type == "cpu" or any(each.device == device for each in tensors_of(capture)):
        return capture
    return changed(capture, lambda it: it.to(device) if torch.is_tensor(it) and it.ndim else it)


def tensors_of(held: Any) -> Iterator[Tensor]:
    """Whatever tensors a checkpoint holds."""
    if isinstance(held, Tensor):
        yield held
    elif isinstance(held, dict | list | tuple):
        for each in held.values() if isinstance(held, dict) else held:
            yield from tensors_of(each)


def changed(held: Any, change: Callable[[Any], Any]) -> Any:
    """What a checkpoint holds, tensors and arrays changed; parameters stay parameters."""
    if isinstance(held, dict):
        return {name: changed(each, change) for name, each in held.items()}
    if isinstance(held, list | tuple):
        return type(held)(changed(each, change) for each in held)
    if not isinstance(held, Tensor | np.ndarray) or (new := change(held)) is held:
        return held
    return torch.nn.Parameter(new.detach()) if getattr(held, "requires_grad", False) else new


def restore_rates(session: SessionState, model: Any) -> None:
    """Give groups the rates that the host set up, if the checkpoint, made from a PLY, has none."""
    groups = [(name, group) for name, group in session.groups(model) if name]
    if not any(group["lr"] for _, group in groups):
        for name, group in groups:
            group["lr"] = session.rates[model].get(name, group["lr"])


def rows_of(means: Tensor, among: Tensor, where: str) -> Tensor:
    """(M,) int64: for each mean (M, 3), the first row of ``among`` (N, 3) with the same bits."""
    rows = copies([among.cpu()], [means])
    if lost := int((rows < 0).sum()):
        found = f"{lost} of {len(rows)} positions without a Gaussian"
        remedy = "Report this with the host's commit: it packs another model."
        raise AlignmentError(where, found, f"positions of the {len(among)} Gaussians", remedy)
    return rows
