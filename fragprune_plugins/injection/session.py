"""One session: a host with its seams wrapped, every call handed to the handler of its role."""

from __future__ import annotations

import contextlib
from collections.abc import Iterator
from functools import cached_property, partial
from pathlib import Path
from typing import Any

from fragprune_plugins.errors import SessionError
from fragprune_plugins.hosts.adapter import ScriptAdapter
from fragprune_plugins.hosts.findings import Finding
from fragprune_plugins.hosts.seams import Seam, SeamCall
from fragprune_plugins.injection import aligning, rasterizing, saving, stepping
from fragprune_plugins.injection.patching import PatchLedger
from fragprune_plugins.injection.stand_ins import StandIns
from fragprune_plugins.injection.state import SessionState
from fragprune_plugins.learning.events import Summary
from fragprune_plugins.learning.thresholds import ThresholdStore
from fragprune_plugins.plugins import hookspecs

_OF_CALLS = stepping.OF_CALLS | rasterizing.OF_CALLS | saving.OF_CALLS
_OF_MODELS = stepping.OF_MODELS | aligning.OF_MODELS | saving.OF_MODELS

_active: Session | None = None


def active_session() -> Session | None:
    """The session of this process, if any."""
    return _active


class Session(SessionState):
    """Thresholds injected into one host in this process; a context manager."""

    _ledger: PatchLedger | None = None

    @cached_property
    def _stand_ins(self) -> StandIns:
        return StandIns(self.dialect, partial(rasterizing.draw, self), self.drop_in)

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
            self._stand_ins.refuse_leftovers(self.repo.root)
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
        self._stand_ins.take_back()
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

    def finish(self) -> Summary:
        """What was gained; observers are told."""
        state = self.last_state
        stage = state.stage if state else None
        if stage is not None and stage.taken == stage.steps:
            stage.close()
        done = stage.progress() if stage else None
        summary = Summary(
            adapter=self.adapter.name,
            engine=", ".join(dict.fromkeys(engine.name for engine in self.engines.values())),
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

    def install_stand_ins(self) -> None:
        """Put ours in place of the host's compiled packages, and wrap nothing.

        ``activate`` does it too; ``deactivate`` takes them back after either.

        Raises:
            LateImportError: the host has imported one of its own.
        """
        self._stand_ins.place()

    def _enter(self, seam: Seam, function: Any, instance: Any, args: Any, kwargs: Any) -> Any:
        """Hand a call to the handler of its role: as it is, or with the model it is about."""
        call = SeamCall(seam, function, instance, args, kwargs)
        if seam.role in _OF_CALLS:
            return _OF_CALLS[seam.role](self, call)
        call.model = self.model_of(call)
        return call.run() if call.model is None else _OF_MODELS[seam.role](self, call)
