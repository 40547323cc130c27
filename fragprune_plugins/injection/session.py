"""One session: a host with its seams wrapped, every call handed to the handler of its role."""

from __future__ import annotations

import contextlib
import importlib
import sys
from collections.abc import Callable, Iterator
from functools import cached_property, partial
from pathlib import Path
from typing import Any

from fragprune_plugins.errors import SessionError
from fragprune_plugins.hosts.adapter import ScriptAdapter
from fragprune_plugins.hosts.findings import Finding
from fragprune_plugins.hosts.seams import Role, Seam, SeamCall
from fragprune_plugins.injection import aligning, ranks, rasterizing, saving, similarity, stepping
from fragprune_plugins.injection.patching import PatchLedger
from fragprune_plugins.injection.stand_ins import StandIns
from fragprune_plugins.injection.state import SessionState
from fragprune_plugins.learning.events import Summary
from fragprune_plugins.learning.thresholds import ThresholdStore
from fragprune_plugins.plugins import hookspecs

OF_CALLS: dict[Role, Callable[[SessionState, SeamCall], Any]] = {
    Role.SCENE: stepping.on_scene,
    Role.VIEW: rasterizing.on_view,
    Role.RASTERIZE: rasterizing.on_rasterize,
    Role.LOSS: rasterizing.on_loss,
    Role.SIMILARITY: similarity.on_similarity,
    Role.METRIC: rasterizing.on_metric,
    Role.ANSWER: lambda session, call: call.how(),
    Role.PACK: saving.on_pack,
    Role.UNPACK: saving.on_unpack,
}
OF_MODELS: dict[Role, Callable[[SessionState, SeamCall], Any]] = {
    Role.ATTACH: stepping.on_attach,
    Role.STEP: stepping.on_step,
    Role.KEEP: aligning.on_keep,
    Role.APPEND: aligning.on_append,
    Role.REARRANGE: aligning.on_rearrange,
    Role.STILL: aligning.on_still,
    Role.SAVE: saving.on_save,
    Role.LOAD: saving.on_load,
    Role.CAPTURE: saving.on_capture,
    Role.RESTORE: saving.on_restore,
}
"""Handlers of calls that concern a model, which they get."""

_active: Session | None = None


def active_session() -> Session | None:
    """The active session of this process, or None."""
    return _active


class Session(SessionState):
    """Injects thresholds into one host in this process; a context manager that (de)activates.

    ``SessionState`` documents the arguments.
    """

    _ledger: PatchLedger | None = None

    @cached_property
    def stand_ins(self) -> StandIns:  # type: ignore[override]
        """The stand-ins for the host's compiled packages."""
        return StandIns(self.dialect, partial(rasterizing.draw, self), self.drop_in)

    def activate(self) -> Session:
        """Wrap every seam. Call it before the host's imports; if it raises, nothing stays patched.

        Raises:
            SessionError: another session is active.
            LateImportError: the host is already imported.
            SeamError: a function to wrap is missing or lacks a parameter.
            RanksError: it is to learn, and several processes train the model together.
        """
        global _active
        if _active is not None:
            remedy = "Deactivate that one first: fragprune_plugins.deactivate()."
            raise SessionError("activate()", "a session is active", "no active session", remedy)
        if self.learn:
            ranks.expect_one()
        packages = self.adapter.installed if self.repo.package else ()
        self._ledger = PatchLedger(self.repo.root, packages)
        enter = self._enter
        if self.learn:  # a host may compile what calls a seam; optimizers import dynamo anyway
            enter = importlib.import_module("torch._dynamo").disable(enter)
        try:
            self.stand_ins.place()
            for seam in self.adapter.seams_for(self.repo):
                self._ledger.wrap(seam, partial(enter, seam))
            extra = similarity.seam_of(self.repo)
            if extra is not None and extra.module not in sys.modules:  # late, it is the host's
                self._ledger.wrap(extra, partial(enter, extra))
            self._ledger.wrap(rasterizing.SCALER, partial(rasterizing.refuse_scaled, self))
            if self.look is not None and self.adapter.steps_by_rendering:
                self._ledger.wrap(stepping.LOADER, partial(stepping.on_photograph, self))
            self.stand_ins.refuse_leftovers(self.repo.root)
        except BaseException:
            self._take_back()
            raise
        _active = self
        return self

    def deactivate(self) -> list[Finding]:
        """Restore every original, if active; a finding for each that could not be restored."""
        global _active
        if _active is self:
            _active = None
        return self._take_back()

    def _take_back(self) -> list[Finding]:
        self.held = None
        for state in self.models.values():
            while state.hooks:
                state.hooks.pop().remove()
            state.hooked.clear()
            state.views.clear()  # their calls hold the host's model, cameras and photographs
            state.newest = None
        findings = self._ledger.undo() if self._ledger else []
        self._ledger = None
        self.stand_ins.take_back()
        return findings

    def __enter__(self) -> Session:
        return self if _active is self else self.activate()

    def __exit__(self, *exc: object) -> None:
        self.deactivate()

    @contextlib.contextmanager
    def paused(self) -> Iterator[None]:
        """Inside, the host draws without thresholds; the session still follows rows."""
        token = self.pausing.set(True)
        try:
            yield
        finally:
            self.pausing.reset(token)

    def store(self, model: Any) -> ThresholdStore | None:
        """The thresholds of a model object, or None."""
        state = self.models.get(model)
        return state.store if state else None

    def finish(self) -> Summary:
        """End learning, tell observers, and return the summary."""
        state = self.last_state
        stage = state.stage if state else None
        if stage is not None and stage.taken == stage.steps:
            stage.close()
        done = vars(stage.progress()) if stage else {}
        summary = Summary(
            adapter=self.adapter.name,
            engine=", ".join(dict.fromkeys(engine.name for engine in self.engines.values())),
            settings=self.settings.as_dict(),
            **done | {"gaussians": len(state.store) if state else 0},
        )
        self.plugins.tell(hookspecs.fragprune_finished, summary=summary)
        return summary

    def expect_drawn(self) -> None:
        """Check that a run that counted learned steps drew a view with thresholds."""
        stage = self.last_state.stage if self.last_state else None
        if stage and stage.steps and self.settings.goal.presses and not stage.viewed:
            found = f"{stage.steps} steps, and no view of the trained model drawn with thresholds"
            remedy = "Report this with the host's commit: the adapter misses how it draws."
            raise SessionError(self.adapter.name, found, "one view or more in every step", remedy)

    def save_learned(self, iteration: int = 0) -> Path | None:
        """Have the host save the model, as of an iteration, or of its last step if it learned."""
        model = self.last() if self.last else None
        if model is None or self.output is None or not isinstance(self.adapter, ScriptAdapter):
            return None
        state = self.models[model]
        learned = not state.store.neutral or (self.settings.goal.on_area and state.steps > 0)
        if not (learned or iteration):
            return None
        return self.adapter.save_model(model, self.output, iteration or self.start + state.steps)

    def _enter(self, seam: Seam, function: Any, instance: Any, args: Any, kwargs: Any) -> Any:
        """Hand a call to the handler of its role."""
        call = SeamCall(seam, function, instance, args, kwargs)
        if seam.role in OF_CALLS:
            return OF_CALLS[seam.role](self, call)
        call.model = self.model_of(call)
        return call.run() if call.model is None else OF_MODELS[seam.role](self, call)
