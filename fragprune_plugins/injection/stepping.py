"""Learning at a host's own pace: steps counted, optimizers watched, thresholds along."""

from __future__ import annotations

import weakref
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

import torch

from fragprune_plugins.hosts.seams import Role, Seam
from fragprune_plugins.injection.state import ModelState, named
from fragprune_plugins.learning.thresholds import ThresholdStore
from fragprune_plugins.plugins import hookspecs

if TYPE_CHECKING:
    from fragprune_plugins.injection.session import Session


def on_scene(
    session: Session, seam: Seam, wrapped: Any, instance: Any, args: Any, kwargs: Any
) -> Any:
    """Note where the host writes."""
    result = wrapped(*args, **kwargs)
    if getattr(instance, "model_path", None):
        session.output = Path(instance.model_path)
    return result


def on_attach(
    session: Session, seam: Seam, wrapped: Any, model: Any, args: Any, kwargs: Any
) -> Any:
    """A new optimizer: thresholds for a model that has none, else the same rows or new ones."""
    state = session.models.get(model)
    kept = state is not None and is_followed(session, model, state)  # before a new optimizer
    result = wrapped(*args, **kwargs)
    optimizers = session.adapter.optimizers(model, named(wrapped, args, kwargs))
    session.optimizers[model] = [weakref.ref(optimizer) for optimizer in optimizers]
    rows = session.adapter.rows(model)
    if state is not None and not kept:
        before = len(state.store)
        state.store.replace(rows)
        session.changed(state.store, "training_setup", before)
    if not session.learn:
        return result
    if state is None:
        store = ThresholdStore(
            rows, session.adapter.means(model).device, session.settings.threshold_lr
        )
        state = session.models[model] = ModelState(store)
    if state.stage is None:
        state.stage = session.stage2(state)
    session.follow(model, state)
    state.base_rates = {name: group["lr"] for name, group in session.groups(model) if name}
    hook_optimizers(session, model, state)
    session.plugins.tell(hookspecs.fragprune_attached, model=model, store=state.store)
    return result


def is_followed(session: Session, model: Any, state: ModelState) -> bool:
    """Whether the means are the very tensor that was loaded, or trained until now."""
    means = session.adapter.means(model)
    known = [state.loaded() if state.loaded else None]
    known += [each for _, group in session.groups(model) for each in group["params"]]
    return any(each is means for each in known)


def hook_optimizers(session: Session, model: Any, state: ModelState) -> None:
    """See every step of a model's optimizers, before and after."""
    reference = weakref.ref(model)
    for optimizer in (each() for each in session.optimizers[model]):
        if optimizer is None or optimizer in state.hooked:
            continue
        state.hooked.add(optimizer)
        before = partial(before_step, session, reference)
        state.hooks.append(optimizer.register_step_pre_hook(before))
        after = partial(after_step, session, reference)
        state.hooks.append(optimizer.register_step_post_hook(after))


def before_step(session: Session, reference: Any, optimizer: Any, *_: Any) -> None:
    """Stage 2: parameters that do not train get no gradient, so no optimizer touches them."""
    model = reference()
    if model is None or not session.standing_still(model):
        return
    trained = session.adapter.trained_groups(session.settings.train)
    stage, rates = session.models[model].stage, session.models[model].base_rates
    for group in optimizer.param_groups:
        name = session.adapter.group_name(model, group)
        if trained is not None and name not in trained:
            for parameter in group["params"]:
                parameter.grad = None
        elif stage is not None and name in rates and name != "xyz":  # the host sets that one
            group["lr"] = stage.rate(name, rates[name])


def after_step(session: Session, reference: Any, *_: Any) -> None:
    """The store steps once per counted step, however many optimizers the host steps."""
    model = reference()
    state = session.models.get(model) if model is not None else None
    if state is None or state.stepped == state.steps:
        return
    state.stepped = state.steps
    if state.stage is not None:
        state.stage.end()


def on_step(session: Session, seam: Seam, wrapped: Any, model: Any, args: Any, kwargs: Any) -> Any:
    """The host's clock ticks: plan the step and let nothing move that shall not."""
    result = wrapped(*args, **kwargs)
    state = session.models.get(model)
    if state is None or not session.learn:
        return result
    if not (session.adapter.steps_by_rendering and state.begun):
        begin_step(session, model, state)
    return session.adapter.still_rate(result) if session.standing_still(model) else result


def begin_step(session: Session, model: Any, state: ModelState) -> None:
    """Count a step of the host; freeze what stands still, and let stage 2 begin its own."""
    if state.stage is not None:
        state.stage.close()  # before the count: whoever watches may end the run here
    state.begun = True
    state.steps += 1
    if session.standing_still(model):
        if not state.prepared:
            session.adapter.prepare_stage2(model, session.origin or session.output)
            state.prepared = True
        freeze(session, model)
    if state.stage is not None and state.steps > session.from_step:
        state.stage.begin(lambda: session.adapter.opacities(model))


def freeze(session: Session, model: Any) -> None:
    """Frozen parameters ask for no gradient: the engine then skips their share of the work."""
    trained = session.adapter.trained_groups(session.settings.train)
    if trained is None:
        return
    for name, group in session.groups(model):
        for parameter in group["params"]:
            parameter.requires_grad_(name in trained)
            if name not in trained and name in session.adapter.gradients_read:
                parameter.grad = torch.zeros_like(parameter)
    for parameter in session.adapter.elsewhere(model):
        parameter.requires_grad_(False)


OF_CALLS: dict[Role, Callable[..., Any]] = {
    Role.SCENE: on_scene,
}


OF_MODELS: dict[Role, Callable[..., Any]] = {
    Role.ATTACH: on_attach,
    Role.STEP: on_step,
}
