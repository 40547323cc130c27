"""The state of a session: its run and its models. Every handler gets it.

In every role but RASTERIZE, the host's function runs unchanged, and the handler follows it. Steps
are counted here, because hosts pass iterations with an offset. Each model object has one store.
"""

from __future__ import annotations

import weakref
from collections.abc import Callable, Hashable, Iterator
from contextlib import contextmanager
from contextvars import ContextVar
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from fragprune_plugins.engines import Engine
from fragprune_plugins.errors import AlignmentError, SessionError, log
from fragprune_plugins.files import sidecar
from fragprune_plugins.hosts.adapter import HostAdapter
from fragprune_plugins.hosts.dialect import Proof
from fragprune_plugins.hosts.seams import Seam, SeamCall
from fragprune_plugins.hosts.source import HostRepo
from fragprune_plugins.injection.stand_ins import StandIns
from fragprune_plugins.learning.events import PopulationChange
from fragprune_plugins.learning.schedule import Schedule, Settings
from fragprune_plugins.learning.stage2 import Stage2
from fragprune_plugins.learning.thresholds import ThresholdStore
from fragprune_plugins.plugins import hookspecs
from fragprune_plugins.plugins.hooks import engine_for, schedule_for
from fragprune_plugins.plugins.loading import Plugins
from fragprune_plugins.types import one_line


@dataclass
class ModelState:
    """A model's thresholds and the state of its training."""

    store: ThresholdStore
    stage: Stage2 | None = None  # None if thresholds of a sidecar only apply
    steps: int = 0  # the host's, since the session saw the model
    begun: bool = False  # a step has begun, and its loss has not gone backward
    prepared: bool = False  # by the adapter, for stage 2
    views: dict[Hashable, Callable[[], Any]] = field(default_factory=dict)  # each draws it again
    newest: Any = None  # the call whose Gaussians these draw
    seen: dict[Hashable, None] = field(default_factory=dict)  # views to learn from, as they came
    loaded: weakref.ReferenceType[Any] | None = None  # the means that a sidecar was loaded for
    hooked: weakref.WeakSet[Any] = field(default_factory=weakref.WeakSet)
    hooks: list[Any] = field(default_factory=list)
    stepped: int = -1  # value of ``steps`` at the last step of the store
    drawn: int = -1  # likewise, when a view was last drawn to learn from
    pictured: dict[tuple[Hashable, int], int] = field(default_factory=dict)  # by (view, part)
    # per running optimizer step, (param group, the host's rate) to restore
    lent: list[list[tuple[dict[str, Any], Any]]] = field(default_factory=list)
    ordered: bool | None = None  # steps begin, draw, go backward, then optimizers step
    beside: bool = False  # drawn without gradients, or between two such steps: nobody learns

    __repr__ = one_line


class SessionState:
    """The state of one host in this process, and of the models that the host trains.

    Args:
        learn: whether thresholds learn. False only applies thresholds of sidecars and checkpoints
            (``--stage off``, render scripts, the host's own stage 1).
        schedule: replaces the schedule that the plugins create.
        from_step: number of the host's steps before learning and freezing begin.
        freeze: while learning, only the parameters that ``settings.train`` names train.
        start: the host's iteration from which this run resumes; 0 for a fresh run.
        engine: the engine's name; see ``hooks.engine_for``.
        drop_in: whether stand-ins replace the host's compiled packages; None replaces those that
            cannot be imported.
        prove: whether to prove each call of the host's own rasterizer before it draws; None does
            so if thresholds learn. One that would draw with thresholds is always proved.
        trust: a proof that fails warns, and the host goes on.
        output: the host's output folder, if it is known.
        origin: the file that stage 2 resumes; None if it follows in one run.
    """

    stand_ins: StandIns
    look: Callable[[Any], tuple[Settings, Tensor | None]] | None = None
    """Where stage 2 follows in one run, is given the model before its first step: it learns with
    the settings and the Gaussians, (N,) bool, that this gives; None for all."""

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
        prove: bool | None = None,
        trust: bool = False,
        output: Path | None = None,
        origin: Path | None = None,
    ) -> None:
        self.adapter, self.repo, self.plugins = adapter, repo, plugins
        self.settings = settings or Settings()
        self.learn, self.from_step, self.freeze, self.start = learn, from_step, freeze, start
        # Is saved with thresholds: whether they learn in the midst of the host's own training.
        self.midway = {"midway": True} if from_step or not freeze else {}
        self.schedule = schedule or schedule_for(self.settings, plugins)
        self.output, self.origin = output, origin
        self.curves: list[dict[str, float]] = []
        self.engine_name = engine
        self.engines: dict[torch.device, Engine] = {}
        self.drop_in = drop_in
        self.prove, self.trust = learn if prove is None else prove, trust
        self.proofs: dict[tuple[Any, ...], Proof | None] = {}  # by the shape of the call
        self.dialect = adapter.dialect(repo)
        colours = {group.name for group in adapter.groups if group.colour}
        appearance = {"opacity"} | (colours if self.settings.train == "appearance" else set())
        # names of the groups that stage 2 trains; None for all
        self.trained = None if self.settings.train == "all" else appearance
        self.unpacked: tuple[Tensor, ThresholdStore] | None = None  # waits for its model
        self.similar: bool | None = None  # compiled similarity agrees with the host's own
        self.unproved: set[Seam] = set()  # rasterizers of which that was said
        self.absent: set[Seam] = set()  # metrics whose weights cannot be loaded
        self.models: weakref.WeakKeyDictionary[Any, ModelState] = weakref.WeakKeyDictionary()
        self.optimizers: weakref.WeakKeyDictionary[Any, list[weakref.ReferenceType[Any]]] = (
            weakref.WeakKeyDictionary()
        )
        self.rates: weakref.WeakKeyDictionary[Any, dict[str, float]] = weakref.WeakKeyDictionary()
        self.warned = False
        self.main: weakref.ReferenceType[Any] | None = None  # the scene's model, of several
        self.last: weakref.ReferenceType[Any] | None = None
        self.held: Any = None  # the model after its last step, until the host saved it
        self.last_state: ModelState | None = None  # stays when the host drops its model
        self.rendering: ContextVar[tuple[Any, Any] | None] = ContextVar("rendering", default=None)
        self.pausing: ContextVar[bool] = ContextVar("paused", default=False)

    def engine(self, device: torch.device) -> Engine:
        """The engine for tensors on a device, created at the first call, or EngineError."""
        if device not in self.engines:
            engine = engine_for(self.engine_name, device, self.plugins)
            if engine.name == "reference":
                why = "it is exact, and slow; fragprune doctor says why no faster engine is used"
                log.warning("the reference engine draws on %s: %s", device, why)
            self.engines[device] = engine
        return self.engines[device]

    def model_of(self, call: SeamCall) -> Any:
        """The model that a call concerns, or None; means from the adapter identify a model too."""
        found = self.adapter.model_of(call)
        if not isinstance(found, Tensor):
            return found
        models = {**dict.fromkeys(self.models), **dict.fromkeys(self.optimizers)}
        at = found.data_ptr()
        return next((m for m in models if self.adapter.means(m).data_ptr() == at), None)

    def processor(self, device: torch.device) -> str:
        """The name of a GPU, or the kind of another device."""
        return torch.cuda.get_device_name(device) if device.type == "cuda" else device.type

    def standing_still(self, model: Any) -> bool:
        """Whether the model is frozen, because stage 2 has begun."""
        state = self.models.get(model)
        begun = self.from_step == 0 or (state is not None and state.steps > self.from_step)
        return self.learn and self.freeze and begun

    def groups(self, model: Any) -> list[tuple[str | None, dict[str, Any]]]:
        """(name, param group) of all optimizers, the main optimizer's first; adapters name them."""
        known = (each() for each in self.optimizers.get(model, ()))
        optimizers = [optimizer for optimizer in known if optimizer is not None]
        groups = [group for optimizer in optimizers for group in optimizer.param_groups]
        return [(self.adapter.group_name(model, group), group) for group in groups]

    def follow(self, model: Any, state: ModelState) -> None:
        """Make this the model of reports and summaries, unless the scene's own is among several."""
        main = self.main() if self.main else None
        if main is None or main is model or main not in self.models:
            self.last, self.last_state = weakref.ref(model), state

    @contextmanager
    def changing(self, store: ThresholdStore, operation: str) -> Iterator[None]:
        """Tell observers of the rows that a store gets and loses inside."""
        before = len(store)
        yield
        change = PopulationChange(operation, before, len(store))
        self.plugins.tell(hookspecs.fragprune_population_changed, store=store, change=change)

    def save(self, model: Any, path: Path, whole: Path | None = None) -> None:
        """Write a model's thresholds beside the model's file ``path``.

        Neutral thresholds are written in stage 2 only: a sidecar tells its files, a control's too.

        Args:
            whole: the new content for ``sidecar.replace_pair``; None if ``path`` has it already.

        Raises:
            SessionError: the session does not know the model.
            AlignmentError: the model and its thresholds differ in their number of rows.
            DivergedError: thresholds are not finite.
        """
        state = self.models.get(model)
        if state is None:
            found, remedy = "a model without thresholds", "Train the model first."
            raise SessionError("save()", found, "a trained model", remedy)
        self.expect_rows(model, state, str(path))
        learned = state.store.cuts or self.standing_still(model)
        if learned and state.stage is not None and state.stage.warming_up:
            log.warning(
                "%s: saved in step %d of %d, before thresholds open: nothing is truncated yet. "
                "If training ends here, give its length as Settings.iterations.",
                *(path, state.stage.steps, self.settings.iterations),
            )
        self.write_sidecar(path, state.store if learned else None, whole)

    def write_sidecar(
        self, path: Path, store: ThresholdStore | None, whole: Path | None = None
    ) -> None:
        """Write a store's sidecar beside a file; None removes that of an earlier file."""
        about: dict[str, Any] = {"adapter": self.adapter.name, "host_commit": self.repo.commit}
        about["settings"], self.held = self.settings.as_dict() | self.midway, None
        if whole is not None:
            sidecar.replace_pair(path, whole, store, **about)
        elif store is not None:
            sidecar.save(path, store, **about)
        else:
            sidecar.path_beside(path).unlink(missing_ok=True)
        if store is not None:
            self.plugins.tell(hookspecs.fragprune_saved, path=sidecar.path_beside(path))

    def load(self, model: Any, path: Path) -> bool:
        """Load a model's thresholds with ``path``, the file that the host just read, if it has any.

        Raises:
            SidecarError: the sidecar belongs to another file.
            AlignmentError: the file has another number of thresholds than the model has rows.
        """
        means = self.adapter.means(model)
        store = sidecar.thresholds_of(path, len(means), means.device)
        if store is not None:
            self._give(model, store, str(path))
        return store is not None

    def take_up(self, model: Any, saved: dict[str, Any]) -> None:
        """Give a model the thresholds that ``ThresholdStore.state_dict`` gave for its Gaussians."""
        store = ThresholdStore(0, self.adapter.means(model).device, self.settings.threshold_lr)
        store.load_state_dict(saved)
        self._give(model, store, "the saved thresholds")

    def _give(self, model: Any, store: ThresholdStore, where: str) -> None:
        """Give a model thresholds that were read; raises AlignmentError as ``expect_rows`` does."""
        state = ModelState(store, loaded=weakref.ref(self.adapter.means(model)))
        self.expect_rows(model, state, where)
        self.models[model] = state
        self.follow(model, state)
        self.plugins.tell(hookspecs.fragprune_attached, model=model, store=store)

    def expect_rows(self, model: Any, state: ModelState, where: str) -> None:
        """Raise AlignmentError unless a model has one threshold per Gaussian."""
        rows = len(self.adapter.means(model))
        if rows != len(state.store):
            expected = f"{len(state.store)}, one per threshold"
            remedy = "Report this with the host's commit: its rows changed at no seam."
            raise AlignmentError(where, f"{rows} Gaussians", expected, remedy)
