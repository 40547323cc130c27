"""An unfinished stage 2 of a host is kept in a file, and the same command goes on from it.

The order of a host's views and its random streams are in variables of its training loop, which no
seam reaches. So the loop brings them back itself: it runs again from its first iteration up to the
step of the file, but draws empty pictures and trains nothing. Then parameters, moments and
thresholds of the file are put in place, and the run goes on as if it had not ended.
"""

from __future__ import annotations

import logging
from collections.abc import Iterator
from dataclasses import fields, replace
from typing import Any

import torch
from torch import Tensor

from fragprune_plugins.engines import Engine
from fragprune_plugins.errors import CheckpointError
from fragprune_plugins.files.checkpoints import UNFIT
from fragprune_plugins.injection.state import ModelState, SessionState
from fragprune_plugins.learning.events import StepStats
from fragprune_plugins.types import RasterInputs, RasterOutputs

log = logging.getLogger("fragprune")

_NAMES = tuple(each.name for each in fields(StepStats))


def between_steps(session: SessionState, model: Any, state: ModelState) -> None:
    """Before a step begins: put the file in place if its step is reached, or write it if due."""
    if session.kept is None or state.stage is None:
        return
    if session.unfinished is not None:
        if state.steps == state.replayed:
            try:
                _restore(session, model, state, *session.unfinished)
            except UNFIT as error:
                raise CheckpointError(
                    str(session.kept.path),
                    f"parts that do not fit together ({error})",
                    "what a stage 2 of this host wrote",
                    "Begin anew with --again.",
                ) from error
            session.unfinished = None
            log.info("stage 2 goes on after step %d", state.steps)
    elif state.steps and session.kept.due(state.steps):
        try:
            session.kept.save(*_state(session, model, state))
        except (TypeError, RuntimeError) as error:  # an optimizer of values that no file takes
            log.warning("stage 2 cannot be kept for after a kill: %s", error)
            session.kept = None


def draw_nothing(engine: Engine, inputs: RasterInputs, _: int = 0) -> RasterOutputs:
    """The background alone, with gradients of zero, in the time that it takes to look at N rows."""
    splats = inputs.splats
    faint = replace(splats, opacities=splats.opacities * 0)  # below every alpha that is drawn
    outputs = engine.rasterize(replace(inputs, splats=faint), None)
    if not outputs.image.requires_grad:  # the host goes backward from it
        outputs = replace(outputs, image=outputs.image.detach().requires_grad_())
    return outputs


def _trained(session: SessionState, model: Any) -> Iterator[tuple[str, Tensor, dict[str, Any]]]:
    """(key, parameter, the optimizer's state of it) of everything of the host's that trains."""
    trained = session.adapter.trained_groups(session.settings.train)
    for number, each in enumerate(session.optimizers[model]):
        optimizer = each()
        for place, group in enumerate(() if optimizer is None else optimizer.param_groups):
            if trained is None or session.adapter.group_name(model, group) in trained:
                for index, parameter in enumerate(group["params"]):
                    key = f"host.{number}.{place}.{index}"
                    yield key, parameter, optimizer.state[parameter]  # type: ignore[union-attr]


def _state(
    session: SessionState, model: Any, state: ModelState
) -> tuple[dict[str, Tensor], dict[str, Any]]:
    """Tensors and plain values of a stage 2, between two steps."""
    assert state.stage is not None
    tensors, plain = state.stage.state_dict(state.seen)
    others: dict[str, dict[str, Any]] = {}
    for key, parameter, known in _trained(session, model):
        tensors[key] = parameter
        for name, value in known.items():
            if isinstance(value, Tensor):
                tensors[f"{key}.{name}"] = value
            else:
                others.setdefault(key, {})[name] = value
    rows = [[curve[name] for name in _NAMES] for curve in session.curves]
    tensors["curves"] = torch.tensor(rows, dtype=torch.float64)
    values = {"step": state.steps, "stage": plain, "host": others}
    return tensors, values | {"configuration": session.asked}


@torch.no_grad()
def _restore(
    session: SessionState,
    model: Any,
    state: ModelState,
    tensors: dict[str, Tensor],
    values: dict[str, Any],
) -> None:
    """Put in place what ``_state`` gave.

    Raises:
        CheckpointError: the host's parameters have other shapes.
    """
    assert state.stage is not None
    assert session.kept is not None
    device = session.adapter.means(model).device
    for key, parameter, known in _trained(session, model):
        if key not in tensors or tensors[key].shape != parameter.shape:
            raise CheckpointError(
                str(session.kept.path),
                f"no {key} of shape {tuple(parameter.shape)}",
                "what this host trains",
                "Begin anew with --again.",
            )
        parameter.copy_(tensors[key])
        known.clear()
        known.update(values["host"].get(key, {}))
        for name, value in tensors.items():
            if name.startswith(f"{key}."):  # an optimizer counts its steps on the CPU
                moved = value.to(parameter.device) if value.shape == parameter.shape else value
                known[name.removeprefix(f"{key}.")] = moved
    own = {name: each.to(device) for name, each in tensors.items() if not name.startswith("host.")}
    curves = own.pop("curves").tolist()
    state.stage.load_state_dict(own, values["stage"], state.seen)
    points = (dict(zip(_NAMES, row, strict=True)) for row in curves)
    session.curves[:] = [point | {"step": int(point["step"])} for point in points]
