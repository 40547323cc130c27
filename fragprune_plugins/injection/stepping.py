"""Counts the host's steps, watches its optimizers, and lets thresholds step with them."""

from __future__ import annotations

import contextlib
import weakref
from collections.abc import Callable, Iterator
from dataclasses import asdict
from functools import partial
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from fragprune_plugins.errors import log
from fragprune_plugins.hosts.seams import Role, Seam, SeamCall
from fragprune_plugins.injection import ranks
from fragprune_plugins.injection.aligning import held_rows, keep_rows
from fragprune_plugins.injection.state import ModelState, SessionState
from fragprune_plugins.learning.events import StepStats
from fragprune_plugins.learning.stage2 import Stage2
from fragprune_plugins.learning.thresholds import ThresholdStore
from fragprune_plugins.plugins import hookspecs
from fragprune_plugins.plugins.hooks import schedule_for, thresholds_for

LOADER = Seam(
    Role.STEP, "torch.utils.data.dataloader", "_BaseDataLoaderIter.__next__", external=True
)


def on_scene(session: SessionState, call: SeamCall) -> Any:
    """Note the host's output folder, and its model."""
    result = call.run()
    call.how()
    model = getattr(call.instance, "gaussians", None)
    session.main = weakref.ref(model) if model is not None else None
    if getattr(call.instance, "model_path", None):
        session.output = Path(call.instance.model_path)
    return result


def on_attach(session: SessionState, call: SeamCall) -> Any:
    """Give a model with a new optimizer thresholds; its own, if its rows are the same."""
    if session.learn:
        ranks.expect_one()
    model = call.model
    state = session.models.get(model)
    kept = state is not None and is_followed(session, model, state)  # needs the old optimizer
    result = call.run()
    session.optimizers[model] = [weakref.ref(optimizer) for optimizer in call.how()]
    groups = session.groups(model)
    session.rates[model] = {name: group["lr"] for name, group in groups if name}
    means = session.adapter.means(model)
    if state is not None and not kept:
        if not state.store.neutral:
            said = "%s: new Gaussians; %d thresholds begin anew, unless a checkpoint has them"
            log.warning(said, call.seam, len(state.store))
        with session.changing(state.store, "training_setup"):
            state.store.replace(len(means))
    if not session.learn:
        return result
    if state is None:
        store = ThresholdStore(len(means), means.device, session.settings.threshold_lr)
        state = session.models[model] = ModelState(store)
    if state.stage is None:
        state.stage = stage2(session, model, state)
    session.follow(model, state)
    hook_optimizers(session, model, state)
    session.plugins.tell(hookspecs.fragprune_attached, model=model, store=state.store)
    return result


def stage2(session: SessionState, model: Any, state: ModelState) -> Stage2:
    """Create the ``Stage2`` that learns a model's thresholds with the session's plugins."""
    reference = weakref.ref(model)

    def parameters() -> dict[str, Tensor]:
        return {
            name or f"group {number}": parameter
            for number, (name, group) in enumerate(session.groups(reference()))
            for parameter in group["params"]
        }

    return Stage2(
        state.store,
        session.settings,
        session.schedule,
        truncate=partial(thresholds_for, plugins=session.plugins),
        views=state.views,
        watch=partial(report, session, state),
        parameters=parameters,
    )


def on_photograph(
    session: SessionState, read: Callable[..., Any], _: Any, args: Any, kwargs: Any
) -> Any:
    """Look at a model when the host reads the photograph for the first view of stage 2.

    When it draws, arguments are made of Gaussians that may be removed.
    """
    model, state = session.last() if session.last else None, session.last_state
    if model is not None and state is not None and torch.is_grad_enabled():  # no evaluation
        look_at(session, model, state)
    return read(*args, **kwargs)


def look_at(session: SessionState, model: Any, state: ModelState, drawn: Any = None) -> None:
    """Before the first step of a stage 2 in one run, learn with what a look at the model gives.

    Args:
        drawn: what the host is about to draw, if it is: the model, or tensors made of it.
    """
    if session.look is None or state.steps != session.from_step:
        return
    look, session.look = session.look, None
    own = {id(each) for _, _, each in held_rows(model, len(state.store))}
    trained = (each for _, group in session.groups(model) for each in group["params"])
    strange = any(id(p) not in own for p in trained if p.shape[:1] == (len(state.store),))
    obstacles = (
        (isinstance(drawn, Tensor), "its host draws without reading a photograph"),
        (len(session.models) > 1, "several models train"),
        (strange, "another object holds what trains of its Gaussians"),
    )
    if why := next((why for found, why in obstacles if found), ""):
        log.warning("stage 2 learns as asked, without a look at the model: %s", why)
        return
    session.settings, kept = look(model)
    session.schedule = schedule_for(session.settings, session.plugins)
    if kept is not None:
        keep_rows(session, model, kept)
    state.stage = stage2(session, model, state)


def report(session: SessionState, state: ModelState, stats: StepStats) -> None:
    """Keep a finished step of the followed model for the curves, and tell observers."""
    if state is not session.last_state:
        return
    session.curves.append(asdict(stats))
    session.plugins.tell(hookspecs.fragprune_step, stats=stats)


def is_followed(session: SessionState, model: Any, state: ModelState) -> bool:
    """Whether the model's means are the tensor that was loaded, or that the optimizers train."""
    means = session.adapter.means(model)
    known = [state.loaded() if state.loaded else None]
    known += [each for _, group in session.groups(model) for each in group["params"]]
    return any(each is means for each in known)


def hook_optimizers(session: SessionState, model: Any, state: ModelState) -> None:
    """Call ``before_step`` and ``after_step`` around every step of a model's optimizers."""
    of = session, weakref.ref(model)
    for optimizer in (each() for each in session.optimizers[model]):
        if optimizer is not None and optimizer not in state.hooked:
            state.hooked.add(optimizer)
            state.hooks.append(optimizer.register_step_pre_hook(partial(before_step, *of)))
            state.hooks.append(optimizer.register_step_post_hook(partial(after_step, *of)))


def before_step(session: SessionState, reference: Any, optimizer: Any, *_: Any) -> None:
    """In stage 2, remove gradients of frozen parameters, and lend others the rates of stage 2.

    For this step only, because the host saves rates in its checkpoints.
    """
    model = reference()
    state = session.models.get(model) if model is not None else None
    if state is None:
        return
    lent: list[tuple[dict[str, Any], Any]] = []
    state.lent.append(lent)
    if session.standing_still(model):
        trained, stage, rates = session.trained, state.stage, session.rates[model]
        scheduled = {group.name for group in session.adapter.groups if group.scheduled}
        for group in optimizer.param_groups:
            name = session.adapter.group_name(model, group)
            if trained is not None and name not in trained:
                for parameter in group["params"]:
                    parameter.grad = None
            elif stage is not None and name in rates and name not in scheduled:
                lent.append((group, group["lr"]))
                group["lr"] = stage.rate(name, rates[name])
    if state.stage is not None and state.stage.plan is not None:
        state.stage.expect_sound()


def after_step(session: SessionState, reference: Any, *_: Any) -> None:
    """Restore the host's rates; the store steps once, also if the host steps several optimizers."""
    model = reference()
    state = session.models.get(model) if model is not None else None
    if state is None:
        return
    for group, rate in state.lent.pop() if state.lent else ():
        group["lr"] = rate
    if state.stepped == state.steps:
        return
    state.stepped = state.steps
    if state.stage is not None:
        state.stage.end()


def on_step(session: SessionState, call: SeamCall) -> Any:
    """Begin a step of the host; in stage 2 the adapter may choose the value that the host gets."""
    result = call.run()
    state = session.models.get(call.model)
    if state is None or not session.learn:
        return result
    if not (session.adapter.steps_by_rendering and state.begun):
        look_at(session, call.model, state)
        begin_step(session, call.model, state)
    return call.how(result) if session.standing_still(call.model) else result


def begin_step(session: SessionState, model: Any, state: ModelState) -> None:
    """Count a step of the host, and begin a step of stage 2."""
    if state.stage is not None:
        state.stage.close()  # before the count, because an observer may end the run here
    state.begun, state.beside = True, False
    state.steps += 1
    if session.standing_still(model) and not state.prepared:
        session.adapter.prepare_stage2(model, session.origin)
        state.prepared = True
    if state.steps >= session.from_step + session.settings.iterations:
        session.held = model
    if state.stage is not None and state.steps > session.from_step:
        state.stage.begin(lambda: session.adapter.opacities(model))


def frozen_parameters(session: SessionState, model: Any) -> list[Tensor]:
    """Parameters of a model that are frozen in this step; none outside stage 2."""
    trained = session.trained
    if trained is None or not session.standing_still(model):
        return []
    groups = [group for name, group in session.groups(model) if name not in trained]
    own = [parameter for group in groups for parameter in group["params"]]
    return own + session.adapter.extra_parameters(model)


@contextlib.contextmanager
def asking_for_no_gradient(parameters: list[Tensor]) -> Iterator[Callable[[Any], Any]]:
    """Inside, these parameters require no gradient, so an engine does not compute theirs.

    Yields a function that detaches an argument which depends on these parameters alone.
    """
    changed = [parameter for parameter in parameters if parameter.requires_grad]
    known = {id(parameter) for parameter in parameters}

    def cut(value: Any) -> Any:
        return value.detach() if depends_only_on(known, value) else value

    for parameter in changed:
        parameter.requires_grad_(False)
    try:
        yield cut
    finally:
        for parameter in changed:
            parameter.requires_grad_(True)


def depends_only_on(known: set[int], value: Any) -> bool:
    """Whether a value is a tensor whose graph has only leaves with these ids."""
    if not known or not isinstance(value, Tensor) or value.grad_fn is None:
        return False
    waiting: list[Any] = [value.grad_fn]
    seen, leaves = set(), 0
    while waiting:
        node = waiting.pop()
        if node is None or node in seen:
            continue
        seen.add(node)
        if (leaf := getattr(node, "variable", None)) is not None:
            leaves += 1
            if id(leaf) not in known:
                return False
        waiting += [before for before, _ in node.next_functions]
    return leaves > 0
