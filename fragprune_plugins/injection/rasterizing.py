"""Draws the host's views with thresholds and adds the pressure to its loss."""

from __future__ import annotations

import math
from collections.abc import Callable, Hashable, Iterator
from contextlib import contextmanager
from dataclasses import replace
from functools import partial
from typing import Any

import torch
from torch import Tensor

from fragprune_plugins.constants import NEUTRAL_LOGIT
from fragprune_plugins.errors import AlignmentError, InputError, SessionError, UsageError, log
from fragprune_plugins.hosts.dialect import HostCall
from fragprune_plugins.hosts.seams import Role, Seam, SeamCall
from fragprune_plugins.injection.proofs import proved
from fragprune_plugins.injection.saving import attach_file
from fragprune_plugins.injection.state import ModelState, SessionState
from fragprune_plugins.injection.stepping import (
    asking_for_no_gradient,
    begin_step,
    frozen_parameters,
    look_at,
)
from fragprune_plugins.learning.area import area_per_pixel
from fragprune_plugins.learning.goals import Fewer
from fragprune_plugins.plugins.hooks import drawn_by, thresholds_for
from fragprune_plugins.types import RasterInputs, RasterOutputs

_AMP = "torch.amp" if hasattr(torch.amp, "GradScaler") else "torch.cuda.amp"  # before torch 2.3
Draw = Callable[[RasterInputs, Tensor | None], RasterOutputs]
SCALER = Seam(Role.LOSS, f"{_AMP}.grad_scaler", "GradScaler.scale", ("outputs",), external=True)


class _AddToLoss(torch.autograd.Function):
    """Returns the image; the backward pass treats ``term`` as a summand of the loss."""

    @staticmethod
    def forward(ctx: Any, image: Tensor, term: Tensor) -> Tensor:
        ctx.term_shape = term.shape
        return image.view_as(image)

    @staticmethod
    def backward(ctx: Any, *grads: Tensor) -> tuple[Tensor, Tensor]:
        (grad,) = grads
        return grad, grad.new_ones(ctx.term_shape)


def on_view(session: SessionState, call: SeamCall) -> Any:
    """Remember the model and the camera while the host draws a view."""
    own = len(call.seam.needs) > 1  # a function takes the model; a method belongs to it
    model = call.arguments[call.seam.needs[1]] if own else session.model_of(call)
    if model is None:
        expect_unpacked_attached(session, call)
        if session.learn and torch.is_grad_enabled() and not session.warned:
            session.warned = True
            log.warning("%s draws Gaussians that no seam attached, without thresholds", call.seam)
        return call.run()
    if session.unpacked is not None:
        attach_file(session, model, *session.unpacked)
    state, view = session.models.get(model), session.adapter.view(call.first)
    learned = torch.is_grad_enabled()
    begins = session.adapter.steps_by_rendering and session.learn and learned
    if begins and state is not None and not state.begun:
        if call.how(True):
            look_at(session, model, state, model if own else session.adapter.model_of(call))
            begin_step(session, model, state)
        else:
            expect_to_train(session, call, model)
    if state is not None and state.stage is not None:
        state.beside = not learned or (state.ordered is True and state.stepped == state.steps)
        if not state.beside:
            state.drawn = state.steps
            if state.stage.plan is not None:
                views = view if isinstance(view, tuple) else (view,)
                state.seen |= dict.fromkeys(views)
                if isinstance(session.settings.goal, Fewer):  # a kept view keeps its model alive
                    state.views |= dict.fromkeys(views, again(session, model, state, view, call))
        state.stage.picture = str(getattr(call.first, "image_name", ""))
    return draw_view(session, model, view, call, {})


def draw_view(session: SessionState, model: Any, view: Any, call: SeamCall, own: Any) -> Any:
    """Call the host's function; inside, ``session.rendering`` holds its model and view."""
    token = session.rendering.set((model, view))
    try:
        with asking_for_no_gradient(frozen_parameters(session, model)) as cut:
            return call.run(**{name: cut(it) for name, it in (call.arguments | own).items()})
    finally:
        session.rendering.reset(token)


def again(*drawn: Any) -> Callable[[], Any]:
    """Draws a view again; tensors of all Gaussians are the newest call's, so that none are kept."""
    session, model, state, view, call = drawn
    state.newest, rows = call, len(state.store)
    shapes = {name: getattr(each, "shape", ()) for name, each in call.arguments.items()}
    own = {name: call.arguments[name] for name, each in shapes.items() if each[:1] != (rows,)}
    return lambda: draw_view(session, model, view, state.newest, own)


def expect_to_train(session: SessionState, call: SeamCall, model: Any) -> None:
    """Refuse to learn in a phase of the host's training that comes before stage 2."""
    if session.standing_still(model):
        where, found = f"{session.adapter.name}: {call.seam}", "an earlier phase than stage 2's"
        remedy = "Name a trained model to start from, or an iteration above 0 after which stage 2 "
        remedy += "begins: --from-iter, or activate(from_iter=...)."
        raise UsageError(where, found, "a trained model, because stage 2 freezes it", remedy)


def expect_unpacked_attached(session: SessionState, call: SeamCall) -> None:
    """Refuse to draw an unpacked file's Gaussians without its thresholds."""
    means = session.adapter.model_of(call)
    if session.unpacked is None or session.pausing.get() or not isinstance(means, Tensor):
        return
    if torch.equal(means.detach().cpu(), session.unpacked[0]):
        found = "Gaussians of a file with thresholds, in a model that no seam attached"
        remedy = "Attach it first, or load them: session.load(model, path). To draw without, use "
        remedy += "fragprune_plugins.paused()."
        raise SessionError(str(call.seam), found, "a model with its thresholds", remedy)


def on_rasterize(session: SessionState, call: SeamCall) -> Any:
    """Draw with thresholds and the stop. Without either the host's rasterizer draws."""
    rendering = session.rendering.get()
    state = session.models.get(rendering[0]) if rendering else None
    drawn = HostCall.of(call)
    means, gpu = drawn[session.dialect.means], session.dialect.own_kernels == "gpu"
    runs = not gpu or means.is_cuda
    by_host = call.run if runs else partial(draw, session, drawn)
    if rendering is None or session.pausing.get():
        return by_host()
    answer = proved_answer(session, call, drawn, state) if runs else session.dialect.answer
    if state is None:
        return by_host()
    rows = session.dialect.rows_drawn(rendering[0], drawn)
    if rows is not None:
        session.expect_rows(rendering[0], state, f"{session.adapter.name}: rasterizer call")
    expected = len(state.store if rows is None else rows)
    if len(means) != expected:
        where, found = f"{session.adapter.name}: rasterizer call", f"{len(means)} Gaussians"
        said = f"{expected} of {len(state.store)}, one per drawn threshold"
        remedy = "Report this with the host's commit: it draws other rows than its model has."
        raise AlignmentError(where, found, said, remedy)
    stage = state.stage
    presses = stage is not None and stage.learning and session.settings.goal.on_area
    if not state.store.cuts and not presses:
        return by_host()
    with directly(means.device):
        inputs, by_ours = unpack(session, drawn)
        inputs = replace(inputs, **state.store.rules)
        if stage is None:
            thresholds = thresholds_for(inputs, state.store, session.plugins)
        else:
            thresholds = stage.thresholds(inputs)
        if thresholds is not None or inputs.stop is not None or presses:
            if thresholds is not None and rows is not None:
                thresholds = thresholds[rows]
            view = rendering[1]

            def truncated(each: RasterInputs, part: int = 0) -> RasterOutputs:
                picture = (view[part], 0) if isinstance(view, tuple) else (view, part)
                return rasterize(by_ours, state, picture, thresholds, each)

            return answer(drawn, inputs, truncated)
    return by_host()


def covering(thresholds: Tensor | None, inputs: RasterInputs) -> Tensor | None:
    """The thresholds (N,), followed by neutral ones for rows that were added behind."""
    if thresholds is None or len(thresholds) == len(inputs.splats):
        return thresholds
    added = thresholds.new_full((len(inputs.splats) - len(thresholds),), NEUTRAL_LOGIT).sigmoid()
    return torch.cat([thresholds, added])


def further_picture(state: ModelState, picture: tuple[Hashable, int]) -> bool:
    """Whether this was drawn before in this step: only a step's first picture bears pressure."""
    if not torch.is_grad_enabled():
        return False
    drawn, state.pictured[picture] = state.pictured.get(picture), state.steps
    return drawn == state.steps


def proved_answer(
    session: SessionState, call: SeamCall, drawn: HostCall, state: ModelState | None
) -> Callable[..., Any]:
    """What answers a call, once the host's own rasterizer is proved, if it needs and can be.

    Where nothing of ours draws, a later call of a stage may fail: stage 2 would refuse it.
    """
    ours, prover = state is not None and state.store.cuts, session.dialect.prover
    if not session.prove and not ours:
        return session.dialect.answer
    stands_in = session.stand_ins.answers(call.seam.module)
    if prover is None or stands_in:
        why = "a stand-in of ours draws here" if stands_in else "its calls have another form"
        if call.seam not in session.unproved:
            session.unproved.add(call.seam)
            log.info("%s: nothing is proved, because %s", call.seam.module, why)
        return session.dialect.answer
    strict = ours or session.learn or not session.proofs
    proof = proved(session, prover, call, drawn, strict=strict)
    return session.dialect.answer if proof is None else partial(prover.answer, proof=proof)


def draw(session: SessionState, call: HostCall) -> Any:
    """Draw a call without thresholds, by our engine."""
    with directly(call[session.dialect.means].device):
        inputs, drawn = unpack(session, call)
        return session.dialect.answer(call, inputs, lambda each, _=0: drawn(each, None))


@contextmanager
def directly(device: torch.device) -> Iterator[None]:
    """Inside, torch functions skip the detour of ``--device cpu``, and a host's autocast.

    The first takes as long as a small picture, the second puts Gaussians pixels away.
    """
    kind = "cuda" if device.type == "cuda" else "cpu"  # older torch refuses other names
    with torch._C.DisableTorchFunction(), torch.autocast(kind, enabled=False):
        yield


def unpack(session: SessionState, call: HostCall) -> tuple[RasterInputs, Draw]:
    """Translate the host's call into ``RasterInputs``, and choose what draws on its device.

    Raises:
        InputError: surfels for a portable goal, in stage 1 already.
    """
    engine, rendering = session.engine(call[session.dialect.means].device), session.rendering.get()
    still = rendering is not None and session.standing_still(rendering[0])
    inputs = session.dialect.unpack(replace(call, engine=engine, still=still))
    if session.settings.goal.on_area and inputs.splats.flat:
        found = "surfels (2 scales each), which viewers of 3D Gaussians do not draw"
        raise InputError("portable", found, "3D Gaussians", "Leave --portable out.")
    return inputs, partial(drawn_by, engine)


def rasterize(
    draw: Draw,
    state: ModelState,
    picture: tuple[Hashable, int],
    thresholds: Tensor | None,
    inputs: RasterInputs,
) -> RasterOutputs:
    """Draw with thresholds (N,) or without; while learning, add the pressure to the loss."""
    if further_picture(state, picture) or state.stage is None or state.beside:
        return draw(inputs, covering(thresholds, inputs))
    shown = state.stage.dropped(inputs)
    if thresholds is not None:
        thresholds = thresholds.view_as(thresholds)  # of this picture alone, for its hook
    outputs = draw(shown, thresholds)

    def untruncated() -> RasterOutputs:
        if thresholds is None and inputs.stop is None and shown is inputs:
            return outputs
        return draw(replace(inputs, stop=None), None)

    area = area_per_pixel(inputs) if state.stage.settings.goal.on_area else None
    pressure = state.stage.on_drawn(picture[0], outputs, untruncated, picture[1], area)
    if pressure is None or not outputs.image.requires_grad:
        return outputs
    counted_once(pressure, pressure if thresholds is None else thresholds)
    return replace(outputs, image=_AddToLoss.apply(outputs.image, pressure))  # type: ignore[no-untyped-call]


def counted_once(term: Any, moved: Any) -> None:
    """Let a term count until its gradient came to what it moves: a host may have several losses."""
    felt: list[bool] = []
    if term.requires_grad and moved.requires_grad:
        term.register_hook(lambda grad: torch.zeros_like(grad) if felt else None)
        moved.register_hook(lambda _: felt.append(True))


def on_loss(session: SessionState, call: SeamCall) -> Any:
    """Keep the host's own loss, a scalar, for the curves."""
    if torch.overrides.has_torch_function_unary(call.instance):
        return call.run()  # by a mode, such as that of --device cpu, which calls it once more
    state = session.last_state
    if state is not None and call.instance.numel() == 1:
        if state.stage is not None and (state.begun or len(session.models) == 1):
            state.stage.on_loss(call.instance)
        for each in session.models.values():
            if each.begun or each.stepped == each.steps:
                in_order = each.begun and each.drawn == each.steps
                each.ordered = each.ordered is not False and in_order
            each.begun = False
    return call.run()


def refuse_scaled(
    session: SessionState, scale: Callable[..., Any], scaler: Any, args: Any, kwargs: Any
) -> Any:
    """Refuse a scaled loss: the pressure would be divided with it, and is not multiplied before."""
    if session.learn and scaler.is_enabled():
        found = "a scaled loss, beside which the pressure vanishes"
        remedy = "Train in float32, or with GradScaler(enabled=False)."
        raise UsageError("GradScaler", found, "a loss that nothing scales", remedy)
    return scale(*args, **kwargs)


class Unmeasured(torch.nn.Module):
    """In place of a metric whose weights cannot be loaded."""

    def forward(self, *_: Any) -> Tensor:
        """NaN."""
        return torch.tensor(math.nan)


def on_metric(session: SessionState, call: SeamCall) -> Any:
    """Let a metric, a function or a class, be NaN if its weights cannot be loaded."""
    if call.seam not in session.absent:
        try:
            return call.run()
        except (OSError, ModuleNotFoundError) as error:  # the download failed, or no torchvision
            why = str(error).split("\n")[0]
            log.warning("%s: cannot load its weights (%s); it is NaN", call.seam, why)
            session.absent.add(call.seam)
    return Unmeasured() if isinstance(call.function, type) else Unmeasured()()
