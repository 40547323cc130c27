"""One session: a host with its seams wrapped, the models it trains, what all handlers share.

Host first: in every role but RASTERIZE the host's function runs unchanged and we follow. Count
steps ourselves: hosts pass offset iterations. One store per model object.
"""

from __future__ import annotations

import contextlib
import logging
import os
import sys
import weakref
from collections.abc import Iterator
from contextvars import ContextVar
from dataclasses import asdict, replace
from functools import partial
from pathlib import Path
from types import ModuleType
from typing import Any

import torch
from torch import Tensor

from fragprune_plugins.engines import Engine
from fragprune_plugins.errors import AlignmentError, LateImportError, SessionError
from fragprune_plugins.hosts.adapter import HostAdapter, HostCall, ScriptAdapter
from fragprune_plugins.hosts.findings import Finding
from fragprune_plugins.hosts.seams import Seam, SeamCall
from fragprune_plugins.hosts.source import HostRepo
from fragprune_plugins.injection import aligning, rasterizing, saving, stepping
from fragprune_plugins.injection.patching import PatchLedger
from fragprune_plugins.injection.state import ModelState
from fragprune_plugins.learning.events import PopulationChange, StepStats, Summary
from fragprune_plugins.learning.schedule import Schedule, Settings
from fragprune_plugins.learning.stage2 import Stage2
from fragprune_plugins.learning.thresholds import ThresholdStore
from fragprune_plugins.plugins import hookspecs
from fragprune_plugins.plugins.hooks import engine_for, schedule_for, thresholds_for
from fragprune_plugins.plugins.loading import Plugins
from fragprune_plugins.storage import sidecar
from fragprune_plugins.types import RasterInputs

log = logging.getLogger("fragprune")

_OF_CALLS = stepping.OF_CALLS | rasterizing.OF_CALLS | saving.OF_CALLS
_OF_MODELS = stepping.OF_MODELS | aligning.OF_MODELS | saving.OF_MODELS

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
        engine: name, see ``hooks.engine_for``.
        drop_in: put our stand-ins in place of the host's compiled packages: True, False, or None
            for those that cannot be imported.
        output: the host's output folder, when known.
        origin: stage 1's, where stage 2 has another.
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
        origin: Path | None = None,
    ) -> None:
        self.adapter, self.repo, self.plugins = adapter, repo, plugins
        self.settings = settings or Settings()
        self.learn, self.from_step, self.freeze = learn, from_step, freeze
        self.start = start
        self.schedule = schedule or schedule_for(self.settings, plugins)
        self.output, self.origin = output, origin
        self.curves: list[dict[str, float]] = []
        self._engine_name = engine
        self._engines: dict[torch.device, Engine] = {}
        self._drop_in = drop_in
        self.dialect = adapter.dialect(repo)
        self._ledger: PatchLedger | None = None
        self._made: dict[str, ModuleType] = {}  # once: a host keeps what it imported
        self._stand_ins: dict[str, ModuleType] = {}  # those in sys.modules
        self.unpacked: tuple[Tensor, ThresholdStore] | None = None  # not yet a model's
        self.absent: set[Seam] = set()  # metrics without their weights
        self.models: weakref.WeakKeyDictionary[Any, ModelState] = weakref.WeakKeyDictionary()
        self.optimizers: weakref.WeakKeyDictionary[Any, list[weakref.ReferenceType[Any]]] = (
            weakref.WeakKeyDictionary()
        )
        self.rates: weakref.WeakKeyDictionary[Any, dict[str, float]] = weakref.WeakKeyDictionary()
        self.warned = False
        self.last: weakref.ReferenceType[Any] | None = None
        self.last_state: ModelState | None = None  # outlives the host's model
        self.rendering: ContextVar[tuple[Any, int] | None] = ContextVar("rendering", default=None)
        self.pausing: ContextVar[bool] = ContextVar("paused", default=False)

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
            self.install_stand_ins()
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
        for state in self.models.values():
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
        token = self.pausing.set(True)
        try:
            yield
        finally:
            self.pausing.reset(token)

    def store(self, model: Any) -> ThresholdStore | None:
        """The thresholds of a model object, if it has some."""
        state = self.models.get(model)
        return state.store if state else None

    def engine(self, device: torch.device) -> Engine:
        """The engine for tensors on a device, created at its first use there."""
        if device not in self._engines:
            engine = engine_for(self._engine_name, device, self.plugins)
            if engine.name == "reference":
                log.warning(
                    "drawing on %s with the reference engine: exact, and slow; "
                    "fragprune doctor says why no faster one is used",
                    device,
                )
            self._engines[device] = engine
        return self._engines[device]

    def finish(self) -> Summary:
        """What was gained; observers are told."""
        state = self.last_state
        stage = state.stage if state else None
        if stage is not None and stage.taken == stage.steps:
            stage.close()
        done = stage.progress() if stage else None
        summary = Summary(
            adapter=self.adapter.name,
            engine=", ".join(dict.fromkeys(engine.name for engine in self._engines.values())),
            steps=done.steps if done else 0,
            gaussians=len(state.store) if state else 0,
            fragments_before=done.fragments_before if done else None,
            fragments_after=done.fragments_after if done else None,
            target_reached=done.target_reached if done else None,
            settings=self.settings.as_dict(),
        )
        self.plugins.tell(hookspecs.fragprune_finished, summary=summary)
        return summary

    def expect_drawn(self) -> None:
        """Raise where steps were counted as learned and no view was drawn with thresholds."""
        stage = self.last_state.stage if self.last_state else None
        if stage and stage.steps and self.settings.truncate and not stage.viewed:
            raise SessionError(
                self.adapter.name,
                f"{stage.steps} steps, and no view of the trained model drawn with its thresholds",
                "one or more in every step",
                "Report this with the host's commit: it draws in a way that the adapter misses.",
            )

    def save_interrupted(self) -> Path | None:
        """After Ctrl-C: have the host save its model, with what was learned beside it."""
        model = self.last() if self.last else None
        if model is None or self.output is None or not isinstance(self.adapter, ScriptAdapter):
            return None
        state = self.models[model]
        if state.store.neutral:
            return None
        return self.adapter.save_model(model, self.output, self.start + state.steps)

    # -- stand-ins -------------------------------------------------------------------------------

    def install_stand_ins(self) -> None:
        """Put ours in place of the host's compiled packages, and wrap nothing.

        ``activate`` does it too; ``deactivate`` takes them back after either.

        Raises:
            LateImportError: the host has imported one of its own.
        """
        from importlib.util import find_spec

        self._made = self._made or self.dialect.modules(self.draw)
        for name, module in self._made.items():
            package = name.split(".")[0]
            if self._drop_in is None and package not in self._stand_ins:
                wanted = not self.dialect.present(package)
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
        for name, module in self.dialect.spares().items() if self._drop_in else ():
            if name not in sys.modules and find_spec(name) is None:
                log.warning("%s is not installed: the host imports an empty stand-in", name)
                sys.modules[name] = self._stand_ins[name] = module

    def _refuse_leftovers(self) -> None:
        """A host imported under an earlier session holds its classes, and draws with them."""
        inside = f"{self.repo.root}{os.sep}"
        hosts = [
            module
            for module in list(sys.modules.values())
            if str(getattr(module, "__file__", "")).startswith(inside)
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

    def draw(self, call: HostCall) -> Any:
        """The host's picture without thresholds, from our engine."""
        inputs, engine = self.unpack(call)
        return self.dialect.answer(call, inputs, lambda each, _=0: engine.rasterize(each, None))

    def unpack(self, call: HostCall) -> tuple[RasterInputs, Engine]:
        """The host's call as core values, and the engine that draws them."""
        engine = self.engine(call[self.dialect.means].device)
        return self.dialect.unpack(replace(call, engine=engine)), engine

    # -- roles -----------------------------------------------------------------------------------

    def _enter(self, seam: Seam, function: Any, instance: Any, args: Any, kwargs: Any) -> Any:
        """Hand a call to the handler of its role: as it is, or with the model it is about."""
        call = SeamCall(seam, function, instance, args, kwargs)
        if seam.role in _OF_CALLS:
            return _OF_CALLS[seam.role](self, call)
        call.model = self.model_of(call)
        return call.run() if call.model is None else _OF_MODELS[seam.role](self, call)

    def model_of(self, call: SeamCall) -> Any:
        """The model a call is about, by its means where the adapter knows no more; or None."""
        found = self.adapter.model_of(call)
        if not isinstance(found, Tensor):
            return found
        known = ((model, self.adapter.means(model)) for model in self.models)
        return next((m for m, means in known if means.data_ptr() == found.data_ptr()), None)

    def standing_still(self, model: Any) -> bool:
        """Whether the model is frozen now: stage 2 has begun."""
        state = self.models.get(model)
        return bool(
            self.learn and self.freeze and state is not None and state.steps > self.from_step
        ) or (self.learn and self.freeze and self.from_step == 0)

    def groups(self, model: Any) -> list[tuple[str | None, dict[str, Any]]]:
        """Param groups of every optimizer, the main one's first, with the adapter's names."""
        known = (each() for each in self.optimizers.get(model, ()))
        optimizers = [optimizer for optimizer in known if optimizer is not None]
        groups = [group for optimizer in optimizers for group in optimizer.param_groups]
        return [(self.adapter.group_name(model, group), group) for group in groups]

    def follow(self, model: Any, state: ModelState) -> None:
        """This model is the one that reports and summaries are about."""
        self.last, self.last_state = weakref.ref(model), state

    def stage2(self, model: Any, state: ModelState) -> Stage2:
        """Learning for a model's thresholds, as the plugins have it."""
        reference = weakref.ref(model)

        def parameters() -> dict[str, Tensor]:
            return {
                name or f"group {number}": parameter
                for number, (name, group) in enumerate(self.groups(reference()))
                for parameter in group["params"]
            }

        return Stage2(
            state.store,
            self.settings,
            self.schedule,
            truncate=self.truncate,
            views=state.views,
            watch=self.report,
            parameters=parameters,
        )

    def truncate(self, inputs: RasterInputs, store: ThresholdStore) -> Tensor | None:
        """The thresholds that plugins apply to one rasterization."""
        return thresholds_for(inputs, store, self.plugins)

    def report(self, stats: StepStats) -> None:
        """Tell observers of a step that is over."""
        self.curves.append(asdict(stats))
        self.plugins.tell(hookspecs.fragprune_step, stats=stats)

    def changed(self, store: ThresholdStore, operation: str, before: int) -> None:
        """Tell observers that rows changed."""
        change = PopulationChange(operation, before, len(store))
        self.plugins.tell(hookspecs.fragprune_population_changed, store=store, change=change)

    def save(self, model: Any, path: Path) -> None:
        """Write a model's thresholds beside the file ``path`` that holds it.

        Neutral ones only in stage 2, whose files are told by their sidecars: a control's has one.

        Raises:
            SessionError: the model is not one of this session's.
            AlignmentError: it has other rows than thresholds.
            DivergedError: they are not finite.
        """
        state = self.models.get(model)
        if state is None:
            raise SessionError("save()", "a model without thresholds", "one attached", "Train it.")
        self.expect_rows(model, state, str(path))
        if state.store.neutral and not self.standing_still(model):
            # A sidecar of an earlier model under this name would now be refused as stale.
            sidecar.path_beside(path).unlink(missing_ok=True)
        else:
            self.write_sidecar(path, state.store)

    def write_sidecar(self, path: Path, store: ThresholdStore) -> None:
        """A store beside a file, and observers told."""
        written = sidecar.save(
            path,
            store,
            adapter=self.adapter.name,
            host_commit=self.repo.commit,
            settings=self.settings.as_dict(),
        )
        self.plugins.tell(hookspecs.fragprune_saved, path=written)

    def load(self, model: Any, path: Path) -> None:
        """Take a model's thresholds from beside the file ``path`` that it was just loaded from.

        Raises:
            SidecarError: there are none, or they belong to another file.
        """
        store = ThresholdStore(self.adapter.rows(model), self.adapter.means(model).device)
        sidecar.load(path, store)
        means = weakref.ref(self.adapter.means(model))
        state = self.models[model] = ModelState(store, loaded=means)
        self.follow(model, state)
        self.plugins.tell(hookspecs.fragprune_attached, model=model, store=store)

    def expect_rows(self, model: Any, state: ModelState, where: str) -> None:
        """Raise AlignmentError unless a model has one threshold per Gaussian."""
        rows = self.adapter.rows(model)
        if rows != len(state.store):
            raise AlignmentError(
                where,
                f"{rows} Gaussians",
                f"{len(state.store)}, one per threshold",
                "Report this with the host's commit: its rows changed without the store seeing it.",
            )
