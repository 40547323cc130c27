"""The session: what happens at each seam of a running host.

Host first: in every role but RASTERIZE the host's function runs unchanged and we follow. Count
steps ourselves: hosts pass offset iterations. One store per model object.
"""

from __future__ import annotations

import contextlib
import logging
import math
import sys
import weakref
from collections.abc import Callable, Iterator
from contextvars import ContextVar
from dataclasses import asdict, dataclass, field, replace
from functools import partial
from inspect import signature
from pathlib import Path
from types import ModuleType
from typing import Any

import numpy as np
import torch
from torch import Tensor

from fragprune_plugins import sidecar
from fragprune_plugins.adapter import HostAdapter, HostCall
from fragprune_plugins.detect import Finding, HostRepo
from fragprune_plugins.engines import Engine
from fragprune_plugins.errors import AlignmentError, LateImportError, SessionError
from fragprune_plugins.patching import PatchLedger
from fragprune_plugins.plugins import Plugins
from fragprune_plugins.pressure import (
    CALIBRATE_AT,
    CALIBRATION_VIEWS,
    TARGET_TOLERANCE,
    FixedPressure,
    Pressure,
    StepViews,
    calibrate,
)
from fragprune_plugins.schedule import Schedule, Settings, StepPlan
from fragprune_plugins.seams import Role, Seam
from fragprune_plugins.thresholds import ThresholdStore
from fragprune_plugins.types import RasterInputs, RasterOutputs

log = logging.getLogger("fragprune")


@dataclass(frozen=True)
class PopulationChange:
    """Rows of a model changed; the store followed."""

    operation: str
    before: int
    after: int


@dataclass(frozen=True)
class StepStats:
    """One training step that learned.

    Attributes:
        step: of the learning, from 1.
        fragments_per_pixel: drawn, mean over this step's views.
        pressure: lambda used.
        threshold_median: over all Gaussians, in falloff.
        loss: the host's own, without the pressure, summed over this step's views.
    """

    step: int
    fragments_per_pixel: float
    pressure: float
    threshold_median: float
    loss: float = math.nan


@dataclass(frozen=True)
class Summary:
    """What a session gained, over the training views it drew.

    Attributes:
        adapter: its name.
        engine: that drew.
        steps: learned.
        gaussians: in the trained model.
        fragments_before: per pixel, untruncated with the opacities at each view's first visit.
        fragments_after: per pixel, as drawn at each view's last visit.
        target_reached: within 5% of the target speed-up; None without one.
        settings: of the fine-tuning.
    """

    adapter: str
    engine: str
    steps: int
    gaussians: int
    fragments_before: float | None
    fragments_after: float | None
    target_reached: bool | None
    settings: dict[str, Any]


@dataclass
class _ModelState:
    """A model's store and everything counted for it."""

    store: ThresholdStore
    steps: int = 0
    plan: StepPlan | None = None
    begun: bool = False  # a step whose loss has not gone backward yet
    pending_parents: Tensor | None = None
    prepared: bool = False
    base_rates: dict[str, float] = field(default_factory=dict)
    baseline: dict[int, float] = field(default_factory=dict)  # view -> untruncated fragments/px
    drawn: dict[int, float] = field(default_factory=dict)  # view -> fragments/px, last visit
    views: dict[int, Callable[[], Any]] = field(default_factory=dict)  # view -> its last render
    last_drawn: float = 0.0
    step_views: StepViews = field(default_factory=StepViews)
    held: bool = False  # thresholds met their target and stay
    loaded: weakref.ReferenceType[Any] | None = None  # the means a sidecar's thresholds came with
    stats: StepStats | None = None
    hooked: weakref.WeakSet[Any] = field(default_factory=weakref.WeakSet)
    hooks: list[Any] = field(default_factory=list)
    stepped: int = -1


class _AddToLoss(torch.autograd.Function):
    """Passes the image on; in the backward pass the term counts as if added to the loss."""

    @staticmethod
    def forward(ctx: Any, image: Tensor, term: Tensor) -> Tensor:
        ctx.term_shape = term.shape
        return image.view_as(image)

    @staticmethod
    def backward(ctx: Any, *grads: Tensor) -> tuple[Tensor, Tensor]:
        (grad,) = grads
        return grad, torch.ones(ctx.term_shape, dtype=grad.dtype, device=grad.device)


def _named(function: Any, args: Any, kwargs: Any) -> dict[str, Any]:
    """The arguments of a call by name, those left out included; "self" is what it was called on."""
    bound = signature(function).bind(*args, **kwargs)
    bound.apply_defaults()
    return {"self": getattr(function, "__self__", None), **bound.arguments}


def _mean(figures: dict[int, float]) -> float | None:
    return sum(figures.values()) / len(figures) if figures else None


_active: Session | None = None


def active_session() -> Session | None:
    """The session of this process, if any."""
    return _active


class Session:
    """Thresholds injected into one host in this process; a context manager.

    Args:
        adapter: describes the host.
        repo: its checkout.
        plugins: loaded plugins.
        settings: of the fine-tuning.
        learn: False only observes and applies thresholds that sidecars bring (``--stage off``,
            render scripts, the host's own stage 1).
        schedule: replaces the one the plugins create.
        from_step: steps of the host to let pass before learning and freezing begin.
        freeze: in learning, everything but what ``settings.train`` names stands still.
        start: the host's iteration that this run goes on after.
        engine: name, see ``fragprune_create_engine``.
        drop_in: put our stand-ins in place of the host's compiled packages: True, False, or None
            for those that cannot be imported.
        output: the host's output folder, when known.
    """

    def __init__(
        self,
        adapter: HostAdapter,
        repo: HostRepo,
        plugins: Plugins,
        settings: Settings | None = None,
        *,
        learn: bool = True,
        schedule: Schedule | None = None,
        from_step: int = 0,
        freeze: bool = True,
        start: int = 0,
        engine: str = "auto",
        drop_in: bool | None = None,
        output: Path | None = None,
    ) -> None:
        self.adapter, self.repo, self.plugins = adapter, repo, plugins
        self.settings = settings or Settings()
        self.hook = plugins.manager.hook
        self.learn, self.from_step, self.freeze = learn, from_step, freeze
        self.start = start
        self.schedule = schedule or self.hook.fragprune_create_schedule(settings=self.settings)
        self.pressure: Pressure = self.settings.make_pressure() if learn else FixedPressure(0.0)
        self.output = output
        self.curves: list[dict[str, float]] = []
        self._engine_name = engine
        self._engine: Engine | None = None
        self._drop_in = drop_in
        self._dialect = adapter.dialect(repo)
        self._ledger: PatchLedger | None = None
        self._made: dict[str, ModuleType] = {}  # once: a host keeps what it imported
        self._stand_ins: dict[str, ModuleType] = {}  # those in sys.modules
        self._unpacked: tuple[Tensor, ThresholdStore] | None = None  # not yet a model's
        self._absent: set[Seam] = set()  # metrics without their weights
        self._models: weakref.WeakKeyDictionary[Any, _ModelState] = weakref.WeakKeyDictionary()
        self._optimizers: weakref.WeakKeyDictionary[Any, list[weakref.ReferenceType[Any]]] = (
            weakref.WeakKeyDictionary()
        )
        self._warned = False
        self._last: weakref.ReferenceType[Any] | None = None
        self._last_state: _ModelState | None = None  # outlives the host's model
        self._rendering: ContextVar[tuple[Any, int] | None] = ContextVar("rendering", default=None)
        self._paused: ContextVar[bool] = ContextVar("paused", default=False)

    # -- life ------------------------------------------------------------------------------------

    def activate(self) -> Session:
        """Wrap every seam; before the host is imported.

        Raises:
            SessionError: another session is active.
            LateImportError, SeamError: the host is imported already, or is not what it should be.
                Nothing stays patched.
        """
        global _active
        if _active is not None:
            raise SessionError("activate()", "a session is active", "none", "Deactivate it first.")
        self._ledger = PatchLedger(self.repo.root)
        try:
            self._install_stand_ins()
            for seam in self.adapter.seams_for(self.repo):
                self._ledger.wrap(seam, partial(self._enter, seam))
            self._refuse_leftovers()
        except BaseException:
            self._take_back()
            raise
        _active = self
        return self

    def deactivate(self) -> list[Finding]:
        """Restore every original; returns what could not be restored. Harmless when inactive."""
        global _active
        if _active is self:
            _active = None
        return self._take_back()

    def _take_back(self) -> list[Finding]:
        for state in self._models.values():
            while state.hooks:
                state.hooks.pop().remove()
            state.hooked.clear()
        findings = self._ledger.undo() if self._ledger else []
        self._ledger = None
        for name, module in self._stand_ins.items():
            if sys.modules.get(name) is module:
                del sys.modules[name]
        self._stand_ins.clear()
        return findings

    def __enter__(self) -> Session:
        return self if _active is self else self.activate()

    def __exit__(self, *exc: object) -> None:
        self.deactivate()

    @contextlib.contextmanager
    def paused(self) -> Iterator[None]:
        """Inside, the host draws as if we were not here; rows are still followed."""
        token = self._paused.set(True)
        try:
            yield
        finally:
            self._paused.reset(token)

    def store(self, model: Any) -> ThresholdStore | None:
        """The thresholds of a model object, if it has some."""
        state = self._models.get(model)
        return state.store if state else None

    def engine(self, device: torch.device) -> Engine:
        """The engine, created at its first use."""
        if self._engine is None:
            self._engine = self.hook.fragprune_create_engine(name=self._engine_name, device=device)
            assert self._engine is not None  # the built-in plugin always answers
            if self._engine.name == "reference":
                log.warning(
                    "drawing on %s with the reference engine: exact, and slow; "
                    "fragprune doctor says why no faster one is used",
                    device,
                )
        return self._engine

    def finish(self) -> Summary:
        """What was gained; observers are told."""
        state = self._last_state
        if state is not None:
            self._report(state)
        before = _mean(state.baseline) if state else None
        after = _mean(state.drawn) if state else None
        target, reached = self.settings.target_speedup, None
        if target is not None and before and after:
            reached = abs(after * target / before - 1) <= TARGET_TOLERANCE
        summary = Summary(
            adapter=self.adapter.name,
            engine=self._engine.name if self._engine else "",
            steps=self._learned(state) if state else 0,
            gaussians=len(state.store) if state else 0,
            fragments_before=before,
            fragments_after=after,
            target_reached=reached,
            settings=self.settings.as_dict(),
        )
        self.hook.fragprune_finished(summary=summary)
        return summary

    def expect_drawn(self) -> None:
        """Raise where steps were counted as learned and no view was drawn with thresholds."""
        state = self._last_state
        steps = self._learned(state) if state else 0
        if steps and self.settings.truncate and not (state and state.drawn):
            raise SessionError(
                self.adapter.name,
                f"{steps} steps, and no view of the trained model drawn with its thresholds",
                "one or more in every step",
                "Report this with the host's commit: it draws in a way that the adapter misses.",
            )

    def save_interrupted(self) -> Path | None:
        """After Ctrl-C: have the host save its model, with what was learned beside it."""
        model = self._last() if self._last else None
        if model is None or self.output is None:
            return None
        state = self._models[model]
        if state.store.neutral:
            return None
        return self.adapter.save_model(model, self.output, self.start + state.steps)

    # -- stand-ins -------------------------------------------------------------------------------

    def _install_stand_ins(self) -> None:
        from importlib.util import find_spec

        self._made = self._made or self._dialect.modules(self._draw)
        for name, module in self._made.items():
            package = name.split(".")[0]
            if self._drop_in is None and package not in self._stand_ins:
                wanted = not self._dialect.present(package)
            else:
                wanted = package in self._stand_ins if self._drop_in is None else self._drop_in
            if not wanted:
                continue
            if name in sys.modules:
                raise LateImportError(
                    name,
                    "already imported",
                    "activation before the host imports its rasterizer",
                    "Start the host with fragprune run, or call activate() above those imports.",
                )
            sys.modules[name] = self._stand_ins[name] = module
        for name, module in self._dialect.spares().items() if self._drop_in else ():
            if name not in sys.modules and find_spec(name) is None:
                log.warning("%s is not installed: the host imports an empty stand-in", name)
                sys.modules[name] = self._stand_ins[name] = module

    def _refuse_leftovers(self) -> None:
        """A host imported under an earlier session holds its classes, and draws with them."""
        hosts = [
            module
            for module in list(sys.modules.values())
            if (file := getattr(module, "__file__", None))
            and Path(file).is_relative_to(self.repo.root)
        ]
        for name, stand_in in self._stand_ins.items():
            for member, ours in vars(stand_in).items():
                maker = getattr(ours, "__module__", None)
                for module in hosts:
                    held = vars(module).get(member, ours)
                    if held is not ours and maker and getattr(held, "__module__", None) == maker:
                        raise LateImportError(
                            f"{name}.{member}",
                            f"bound in {module.__name__} since an earlier session",
                            "a host that is imported under this one",
                            "Activate that session again, or start a fresh process.",
                        )

    def _draw(self, call: HostCall) -> Any:
        """The host's picture without thresholds, from our engine."""
        inputs = self._dialect.unpack(call)
        engine = self.engine(inputs.splats.device)
        return self._dialect.answer(call, inputs, lambda each, _=0: engine.rasterize(each, None))

    # -- roles -----------------------------------------------------------------------------------

    def _enter(self, seam: Seam, wrapped: Any, instance: Any, args: Any, kwargs: Any) -> Any:
        """Hand a call to the handler of its role: as it is, or with the model it is about."""
        if seam.role in _OF_CALLS:
            return _OF_CALLS[seam.role](self, seam, wrapped, instance, args, kwargs)
        model = self._model_of(instance, _named(wrapped, args, kwargs))
        if model is None:
            return wrapped(*args, **kwargs)
        return _OF_MODELS[seam.role](self, seam, wrapped, model, args, kwargs)

    def _model_of(self, instance: Any, arguments: dict[str, Any]) -> Any:
        """The model a call is about, by its means where the adapter knows no more; or None."""
        found = self.adapter.model_of(instance, arguments)
        if not isinstance(found, Tensor):
            return found
        known = ((model, self.adapter.means(model)) for model in self._models)
        return next((m for m, means in known if means.data_ptr() == found.data_ptr()), None)

    def _learned(self, state: _ModelState) -> int:
        return max(0, state.steps - self.from_step) if self.learn else 0

    def _standing_still(self, model: Any) -> bool:
        """Whether the model is frozen now: stage 2 has begun."""
        state = self._models.get(model)
        return bool(
            self.learn and self.freeze and state is not None and state.steps > self.from_step
        ) or (self.learn and self.freeze and self.from_step == 0)

    def _on_scene(self, seam: Seam, wrapped: Any, instance: Any, args: Any, kwargs: Any) -> Any:
        result = wrapped(*args, **kwargs)
        if getattr(instance, "model_path", None):
            self.output = Path(instance.model_path)
        return result

    def _on_attach(self, seam: Seam, wrapped: Any, model: Any, args: Any, kwargs: Any) -> Any:
        state = self._models.get(model)
        kept = state is not None and self._is_followed(model, state)  # before a new optimizer
        result = wrapped(*args, **kwargs)
        optimizers = self.adapter.optimizers(model, _named(wrapped, args, kwargs))
        self._optimizers[model] = [weakref.ref(optimizer) for optimizer in optimizers]
        rows = self.adapter.rows(model)
        if state is not None and not kept:
            before = len(state.store)
            state.store.replace(rows)
            self._changed(state.store, "training_setup", before)
        if not self.learn:
            return result
        if state is None:
            store = ThresholdStore(
                rows, self.adapter.means(model).device, self.settings.threshold_lr
            )
            state = self._models[model] = _ModelState(store)
        self._follow(model, state)
        state.base_rates = {name: group["lr"] for name, group in self._groups(model) if name}
        self._hook_optimizers(model, state)
        self.hook.fragprune_attached(model=model, store=state.store)
        return result

    def _is_followed(self, model: Any, state: _ModelState) -> bool:
        """Whether the means are the very tensor that was loaded, or trained until now."""
        means = self.adapter.means(model)
        known = [state.loaded() if state.loaded else None]
        known += [each for _, group in self._groups(model) for each in group["params"]]
        return any(each is means for each in known)

    def _groups(self, model: Any) -> list[tuple[str | None, dict[str, Any]]]:
        """Param groups of every optimizer, the main one's first, with the adapter's names."""
        known = (each() for each in self._optimizers.get(model, ()))
        optimizers = [optimizer for optimizer in known if optimizer is not None]
        groups = [group for optimizer in optimizers for group in optimizer.param_groups]
        return [(self.adapter.group_name(model, group), group) for group in groups]

    def _follow(self, model: Any, state: _ModelState) -> None:
        self._last, self._last_state = weakref.ref(model), state

    def _hook_optimizers(self, model: Any, state: _ModelState) -> None:
        reference = weakref.ref(model)
        for optimizer in (each() for each in self._optimizers[model]):
            if optimizer is None or optimizer in state.hooked:
                continue
            state.hooked.add(optimizer)
            before = partial(self._before_step, reference)
            state.hooks.append(optimizer.register_step_pre_hook(before))
            after = partial(self._after_step, reference)
            state.hooks.append(optimizer.register_step_post_hook(after))

    def _before_step(self, reference: Any, optimizer: Any, *_: Any) -> None:
        """Stage 2: parameters that do not train get no gradient, so no optimizer touches them."""
        model = reference()
        if model is None or not self._standing_still(model):
            return
        trained = self.adapter.trained_groups(self.settings.train)
        plan = self._models[model].plan
        rates = self._models[model].base_rates
        decay = 0.1**plan.progress if plan else 1.0
        for group in optimizer.param_groups:
            name = self.adapter.group_name(model, group)
            if trained is not None and name not in trained:
                for parameter in group["params"]:
                    parameter.grad = None
            elif name == "opacity" and plan and plan.opacity_lr is not None:
                group["lr"] = plan.opacity_lr
            elif name in rates and name != "xyz":  # the host sets xyz's rate every iteration
                group["lr"] = rates[name] * decay

    def _after_step(self, reference: Any, *_: Any) -> None:
        """The store steps once per counted step, however many optimizers the host steps."""
        model = reference()
        state = self._models.get(model) if model is not None else None
        if state is None or state.stepped == state.steps:
            return
        state.stepped = state.steps
        if state.plan and state.plan.learn and self.settings.truncate and not state.held:
            state.store.step(state.plan.threshold_lr)

    def _on_step(self, seam: Seam, wrapped: Any, model: Any, args: Any, kwargs: Any) -> Any:
        result = wrapped(*args, **kwargs)
        state = self._models.get(model)
        if state is None or not self.learn:
            return result
        if not (self.adapter.steps_by_rendering and state.begun):
            self._begin_step(model, state)
        return self.adapter.still_rate(result) if self._standing_still(model) else result

    def _begin_step(self, model: Any, state: _ModelState) -> None:
        self._report(state)
        state.step_views.begin()
        state.begun = True
        state.steps += 1
        step = state.steps - self.from_step
        state.plan = self.schedule.at(step) if step > 0 else None
        if self._standing_still(model):
            if not state.prepared:
                self.adapter.prepare_stage2(model, self.output)
                state.prepared = True
            self._freeze(model)
        if state.plan and state.plan.learn and self.settings.truncate:
            state.store.open(self.adapter.opacities(model))
            self._meet_target(state)

    def _meet_target(self, state: _ModelState) -> None:
        """Late in the run, and once more at its end, shift all thresholds onto the target."""
        target, progress = self.settings.target_speedup, state.plan.progress if state.plan else 0.0
        due = progress >= 1.0 or (progress >= CALIBRATE_AT and not state.held)
        if target is None or not due or not state.baseline:
            return
        views = sorted(state.baseline.keys() & state.views.keys())
        views = views[:: -(-len(views) // CALIBRATION_VIEWS)]
        before = sum(state.baseline[view] for view in views)

        @torch.no_grad()
        def speedup() -> float:
            drawn = 0.0
            for view in views:
                state.views[view]()
                drawn += state.last_drawn
            return before / max(drawn, 1e-9)

        calibrate(state.store, speedup, target)
        state.held = True

    def _freeze(self, model: Any) -> None:
        """Frozen parameters ask for no gradient: the engine then skips their share of the work."""
        trained = self.adapter.trained_groups(self.settings.train)
        if trained is None:
            return
        for name, group in self._groups(model):
            for parameter in group["params"]:
                parameter.requires_grad_(name in trained)
                if name not in trained and name in self.adapter.gradients_read:
                    parameter.grad = torch.zeros_like(parameter)
        for parameter in self.adapter.elsewhere(model):
            parameter.requires_grad_(False)

    def _report(self, state: _ModelState) -> None:
        stats, state.stats = state.stats, None  # first, so that an observer may raise
        if stats is not None:
            self.curves.append(asdict(stats))
            self.hook.fragprune_step(stats=stats)

    def _on_view(self, seam: Seam, wrapped: Any, instance: Any, args: Any, kwargs: Any) -> Any:
        arguments = _named(wrapped, args, kwargs)
        camera = arguments[seam.needs[0]]
        own = len(seam.needs) > 1  # a function's; a method's is what it was called on
        model = arguments[seam.needs[1]] if own else self._model_of(instance, arguments)
        if model is None:
            if self.learn and torch.is_grad_enabled():
                self._warn_unknown(seam)
            return wrapped(*args, **kwargs)
        if self._unpacked is not None and model not in self._models:
            self._adopt(model, *self._unpacked)
        state, view = self._models.get(model), self.adapter.view(camera)
        begins = self.adapter.steps_by_rendering and self.learn and torch.is_grad_enabled()
        if begins and state is not None and not state.begun:
            self._begin_step(model, state)
        again = partial(self._render, wrapped, model, view, args, kwargs)
        measured = self.settings.target_speedup is not None  # keeps the model alive: only if needed
        if measured and state is not None and state.plan is not None and torch.is_grad_enabled():
            state.views[view] = again
        return again()

    def _warn_unknown(self, seam: Seam) -> None:
        if not self._warned:
            self._warned = True
            log.warning("%s draws Gaussians that no seam attached: without thresholds", seam)

    def _render(self, render: Any, model: Any, view: int, args: Any, kwargs: Any) -> Any:
        token = self._rendering.set((model, view))
        try:
            return render(*args, **kwargs)
        finally:
            self._rendering.reset(token)

    def _on_rasterize(
        self, seam: Seam, wrapped: Any, rasterizer: Any, args: Any, kwargs: Any
    ) -> Any:
        rendering = self._rendering.get()
        state = self._models.get(rendering[0]) if rendering else None
        settings = getattr(rasterizer, "raster_settings", None)
        call = HostCall.bind(wrapped, settings, args, kwargs, str(seam))
        if self._dialect.stands_in(call):
            wrapped, args, kwargs = self._draw, (call,), {}
        if rendering is None or state is None or self._paused.get():
            return wrapped(*args, **kwargs)
        rows = self.adapter.rows_drawn(rendering[0], call)
        if rows is not None:
            self._expect_rows(rendering[0], state, f"{self.adapter.name}: rasterizer call")
        means, expected = call[self._dialect.means], len(state.store if rows is None else rows)
        if len(means) != expected:
            raise AlignmentError(
                f"{self.adapter.name}: rasterizer call",
                f"{len(means)} Gaussians",
                f"{expected} of {len(state.store)}, one per threshold that is drawn",
                "Report this with the host's commit.",
            )
        if state.store.neutral:
            return wrapped(*args, **kwargs)
        inputs = self._dialect.unpack(call)
        thresholds = self.hook.fragprune_truncate(inputs=inputs, store=state.store)
        if thresholds is None:
            return wrapped(*args, **kwargs)
        thresholds = thresholds if rows is None else thresholds[rows]
        draw = partial(self._rasterize, state, rendering[1], thresholds)
        return self._dialect.answer(call, inputs, draw)

    def _rasterize(
        self, state: _ModelState, view: int, thresholds: Tensor, inputs: RasterInputs, part: int = 0
    ) -> RasterOutputs:
        """With thresholds; learning, with the fragment pressure in the loss."""
        view = hash((view, part)) if part else view
        engine = self.engine(inputs.splats.device)
        outputs = engine.rasterize(inputs, thresholds)
        state.last_drawn = float(outputs.fragments_per_pixel.detach())
        if torch.is_grad_enabled() and state.plan is not None and state.plan.learn:
            if view not in state.baseline:
                with torch.no_grad():
                    untruncated = engine.rasterize(inputs, None)
                state.baseline[view] = float(untruncated.fragments_per_pixel)
            outputs = self._press(state, view, outputs)
        return outputs

    def _press(self, state: _ModelState, view: int, outputs: RasterOutputs) -> RasterOutputs:
        """Put the fragment pressure into the host's loss and keep this step's figures."""
        plan = state.plan
        assert plan is not None
        fragments = state.drawn[view] = state.last_drawn
        state.step_views.draw(fragments)
        self.pressure.observe(plan.progress, fragments / max(state.baseline[view], 1e-9))
        state.stats = StepStats(
            step=state.steps - self.from_step,
            fragments_per_pixel=state.step_views.fragments,
            pressure=self.pressure.value,
            threshold_median=float(state.store.values.detach().median()),
            loss=state.step_views.loss,
        )
        if self.pressure.value == 0 or state.held or not outputs.image.requires_grad:
            return outputs
        term = outputs.fragments_per_pixel * (self.pressure.value / state.step_views.expected)
        return replace(outputs, image=_AddToLoss.apply(outputs.image, term))  # type: ignore[no-untyped-call]

    def _on_loss(self, seam: Seam, wrapped: Any, tensor: Any, args: Any, kwargs: Any) -> Any:
        state = self._last_state
        if state is not None and tensor.numel() == 1:
            state.begun = False
            if state.stats is not None:
                state.step_views.lose(float(tensor.detach()))
                state.stats = replace(state.stats, loss=state.step_views.loss)
        return wrapped(*args, **kwargs)

    def _on_metric(self, seam: Seam, wrapped: Any, instance: Any, args: Any, kwargs: Any) -> Any:
        if seam not in self._absent:
            try:
                return wrapped(*args, **kwargs)
            except OSError as error:  # the download failed; a run of hours should not end on it
                log.warning("%s: its weights cannot be had (%s); NaN stands for it", seam, error)
                self._absent.add(seam)
        return torch.tensor(math.nan)

    def _on_parents(self, seam: Seam, wrapped: Any, model: Any, args: Any, kwargs: Any) -> Any:
        state = self._models.get(model)
        if state is None:
            return wrapped(*args, **kwargs)
        bound = signature(wrapped).bind(*args, **kwargs)
        bound.apply_defaults()
        method = seam.attribute.split(".")[-1]
        state.pending_parents = self.adapter.parents(model, method, bound.arguments)
        try:
            result = wrapped(*args, **kwargs)
            left = 0 if state.pending_parents is None else len(state.pending_parents)
            self._expect_children(seam, f"{left} selected parents without a child", not left)
            return result
        finally:
            state.pending_parents = None

    def _on_append(self, seam: Seam, wrapped: Any, model: Any, args: Any, kwargs: Any) -> Any:
        state = self._models.get(model)
        if state is None:
            return wrapped(*args, **kwargs)
        tensors = signature(wrapped).bind(*args, **kwargs).arguments[seam.needs[0]]
        count, parents = len(next(iter(tensors.values()))), state.pending_parents
        if parents is not None:
            parents, rest = parents[:count], parents[count:]
            state.pending_parents = rest if len(rest) else None  # of what is appended next
            copies = len(parents) == count and self.adapter.check_children(model, tensors, parents)
            what = f"{count} new rows that are not copies of the selected parents"
            self._expect_children(seam, what, copies)
        result = wrapped(*args, **kwargs)
        before = len(state.store)
        state.store.append(count, parents)
        self._changed(state.store, "append", before)
        return result

    def _expect_children(self, seam: Seam, found: str, right: bool) -> None:
        if not right:
            raise AlignmentError(
                str(seam),
                found,
                "one child per selected parent and repeat, in the host's order",
                "Report this with the host's commit: its densification differs.",
            )

    def _on_choice(self, seam: Seam, wrapped: Any, model: Any, args: Any, kwargs: Any) -> Any:
        result = wrapped(*args, **kwargs)
        state = self._models.get(model)
        if state is not None:
            chosen = signature(wrapped).bind(*args, **kwargs).arguments[seam.needs[0]]
            state.pending_parents = chosen.detach().clone()
        return result

    def _on_copy(self, seam: Seam, wrapped: Any, model: Any, args: Any, kwargs: Any) -> Any:
        if self._standing_still(model):
            return None
        state = self._models.get(model)
        if state is None:
            return wrapped(*args, **kwargs)
        mask = signature(wrapped).bind(*args, **kwargs).arguments[seam.needs[0]]
        target = mask.nonzero()[:, 0]
        state.pending_parents = None
        try:
            result = wrapped(*args, **kwargs)
        finally:
            source, state.pending_parents = state.pending_parents, None
        if source is None:  # nothing to overwrite, or nothing to copy
            return result
        groups = [(name, group) for name, group in self._groups(model) if name]
        rows = {name: group["params"][0].detach()[target] for name, group in groups}
        if len(source) != len(target) or not self.adapter.check_children(model, rows, source):
            raise AlignmentError(
                str(seam),
                f"{len(target)} overwritten rows that are not copies of the {len(source)} drawn",
                "one copy per overwritten row, in the host's order",
                "Report this with the host's commit: its relocation differs.",
            )
        state.store.copy(source, target)
        self._changed(state.store, "copy", len(state.store))
        return result

    def _on_forget(self, seam: Seam, wrapped: Any, model: Any, args: Any, kwargs: Any) -> Any:
        result = wrapped(*args, **kwargs)
        state = self._models.get(model)
        if state is not None:
            bound = signature(wrapped).bind(*args, **kwargs)
            bound.apply_defaults()
            state.store.forget(bound.arguments[seam.needs[0]])
        return result

    def _on_keep(self, seam: Seam, wrapped: Any, model: Any, args: Any, kwargs: Any) -> Any:
        result = wrapped(*args, **kwargs)
        state = self._models.get(model)
        if state is not None:
            mask = signature(wrapped).bind(*args, **kwargs).arguments[seam.needs[0]]
            before = len(state.store)
            state.store.keep(mask)
            self._changed(state.store, "keep", before)
        return result

    def _on_rearrange(self, seam: Seam, wrapped: Any, model: Any, args: Any, kwargs: Any) -> Any:
        if self._standing_still(model):
            return None
        state = self._models.get(model)
        if state is None:
            return wrapped(*args, **kwargs)
        with self.adapter.tracing(model, wrapped, _named(wrapped, args, kwargs)) as trace:
            result = wrapped(*args, **kwargs)
        if trace.origins is not None and trace.fresh is not None:
            before = len(state.store)
            state.store.rearrange(trace.origins, trace.fresh)
            self._changed(state.store, "rearrange", before)
        self._expect_rows(model, state, str(seam))
        return result

    def _changed(self, store: ThresholdStore, operation: str, before: int) -> None:
        change = PopulationChange(operation, before, len(store))
        self.hook.fragprune_population_changed(store=store, change=change)

    def _on_still(self, seam: Seam, wrapped: Any, model: Any, args: Any, kwargs: Any) -> Any:
        if self._standing_still(model):
            return self.adapter.stand_still(wrapped, _named(wrapped, args, kwargs))
        return wrapped(*args, **kwargs)

    def _on_save(self, seam: Seam, wrapped: Any, model: Any, args: Any, kwargs: Any) -> Any:
        result = wrapped(*args, **kwargs)
        path = _named(wrapped, args, kwargs)[seam.needs[0]]
        if model in self._models and path is not None:
            self.save(model, self._file_at(seam, path))
        return result

    def _file_at(self, seam: Seam, path: Any) -> Path:
        return self.adapter.file_at(seam.attribute.split(".")[-1], Path(path))

    def save(self, model: Any, path: Path) -> None:
        """Write a model's thresholds beside the file ``path`` that holds it; none if neutral.

        Raises:
            SessionError: the model is not one of this session's.
            AlignmentError: it has other rows than thresholds.
        """
        state = self._models.get(model)
        if state is None:
            raise SessionError("save()", "a model without thresholds", "one attached", "Train it.")
        self._expect_rows(model, state, str(path))
        if state.store.neutral:
            # A sidecar of an earlier model under this name would now be refused as stale.
            sidecar.path_beside(path).unlink(missing_ok=True)
        else:
            self._save(path, state.store)

    def _save(self, path: Path, store: ThresholdStore) -> None:
        written = sidecar.save(
            path,
            store,
            adapter=self.adapter.name,
            host_commit=self.repo.commit,
            settings=self.settings.as_dict(),
        )
        self.hook.fragprune_saved(path=written)

    def _on_load(self, seam: Seam, wrapped: Any, model: Any, args: Any, kwargs: Any) -> Any:
        result = wrapped(*args, **kwargs)
        path = self._file_at(seam, _named(wrapped, args, kwargs)[seam.needs[0]])
        if sidecar.path_beside(path).exists():
            self.load(model, path)
        else:
            self._models.pop(model, None)  # another population: what we knew is not about it
        return result

    def load(self, model: Any, path: Path) -> None:
        """Take a model's thresholds from beside the file ``path`` that it was just loaded from.

        Raises:
            SidecarError: there are none, or they belong to another file.
        """
        store = ThresholdStore(self.adapter.rows(model), self.adapter.means(model).device)
        sidecar.load(path, store)
        means = weakref.ref(self.adapter.means(model))
        state = self._models[model] = _ModelState(store, loaded=means)
        self._expect_rows(model, state, str(path))
        self._follow(model, state)
        self.hook.fragprune_attached(model=model, store=store)

    def _on_pack(self, seam: Seam, wrapped: Any, instance: Any, args: Any, kwargs: Any) -> Any:
        result = wrapped(*args, **kwargs)
        packed = self.adapter.packed(_named(wrapped, args, kwargs), result)
        model = self._last() if self._last else None
        state = self._models.get(model) if model is not None else None
        if packed is None or state is None or state.store.neutral:
            return result
        path, means = packed
        rows = _rows_of(means, self.adapter.means(model), str(seam))
        store = ThresholdStore(0)
        store.load_state_dict(state.store.state_dict())
        store.rearrange(rows, torch.zeros(len(rows), dtype=torch.bool))
        self._save(path, store)
        return result

    def _on_unpack(self, seam: Seam, wrapped: Any, instance: Any, args: Any, kwargs: Any) -> Any:
        result = wrapped(*args, **kwargs)
        packed = self.adapter.packed(_named(wrapped, args, kwargs), result)
        if packed is not None and sidecar.path_beside(packed[0]).exists():
            self._unpacked = packed[1], sidecar.load(packed[0])[0]
        return result

    def _adopt(self, model: Any, expected: Tensor, store: ThresholdStore) -> None:
        """Thresholds of an unpacked file go to the model made of it, which is drawn next."""
        means = self.adapter.means(model)
        if not torch.equal(means.detach().cpu(), expected):
            raise AlignmentError(
                f"{self.adapter.name}: unpacked model",
                f"{len(means)} Gaussians that are not the unpacked file's",
                f"its {len(expected)}, in its order",
                "Report this with the host's commit: it draws another model after unpacking.",
            )
        placed = ThresholdStore(0, means.device)
        placed.load_state_dict(store.state_dict())
        self._models[model] = _ModelState(placed, loaded=weakref.ref(means))
        self._follow(model, self._models[model])
        self.hook.fragprune_attached(model=model, store=placed)
        self._unpacked = None

    def _on_capture(self, seam: Seam, wrapped: Any, model: Any, args: Any, kwargs: Any) -> Any:
        result = wrapped(*args, **kwargs)
        state = self._models.get(model)
        if state is not None and not state.store.neutral:
            self._expect_rows(model, state, str(seam))
            self.adapter.checkpoint_state(result)["fragprune"] = state.store.state_dict()
        return result

    def _on_restore(self, seam: Seam, wrapped: Any, model: Any, args: Any, kwargs: Any) -> Any:
        bound = signature(wrapped).bind(*args, **kwargs)
        capture = self.adapter.before_restore(model, bound.arguments[seam.needs[0]])
        bound.arguments[seam.needs[0]] = capture
        saved = self.adapter.checkpoint_state(capture).pop("fragprune", None)
        result = wrapped(*bound.args, **bound.kwargs)
        state = self._models.get(model)
        if saved is not None:
            if state is None:
                device = self.adapter.means(model).device
                state = self._models[model] = _ModelState(ThresholdStore(0, device))
            state.store.load_state_dict(saved)
            self._expect_rows(model, state, str(seam))
        return result

    def _expect_rows(self, model: Any, state: _ModelState, where: str) -> None:
        rows = self.adapter.rows(model)
        if rows != len(state.store):
            raise AlignmentError(
                where,
                f"{rows} Gaussians",
                f"{len(state.store)}, one per threshold",
                "Report this with the host's commit: its rows changed without the store seeing it.",
            )


def _rows_of(means: Tensor, among: Tensor, where: str) -> Tensor:
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


_OF_CALLS: dict[Role, Callable[..., Any]] = {
    Role.SCENE: Session._on_scene,
    Role.VIEW: Session._on_view,
    Role.RASTERIZE: Session._on_rasterize,
    Role.LOSS: Session._on_loss,
    Role.METRIC: Session._on_metric,
    Role.PACK: Session._on_pack,
    Role.UNPACK: Session._on_unpack,
}

_OF_MODELS: dict[Role, Callable[..., Any]] = {
    Role.ATTACH: Session._on_attach,
    Role.STEP: Session._on_step,
    Role.PARENTS: Session._on_parents,
    Role.KEEP: Session._on_keep,
    Role.APPEND: Session._on_append,
    Role.CHOICE: Session._on_choice,
    Role.COPY: Session._on_copy,
    Role.REARRANGE: Session._on_rearrange,
    Role.FORGET: Session._on_forget,
    Role.STILL: Session._on_still,
    Role.SAVE: Session._on_save,
    Role.LOAD: Session._on_load,
    Role.CAPTURE: Session._on_capture,
    Role.RESTORE: Session._on_restore,
}
