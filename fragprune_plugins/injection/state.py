"""What a session knows, of its run and of each model; every handler is given it.

Host first: in every role but RASTERIZE the host's function runs unchanged and we follow. Count
steps ourselves: hosts pass offset iterations. One store per model object.
"""

from __future__ import annotations

import logging
import weakref
from collections.abc import Callable
from contextvars import ContextVar
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from fragprune_plugins.engines import Engine
from fragprune_plugins.errors import AlignmentError, SessionError
from fragprune_plugins.hosts.adapter import HostAdapter
from fragprune_plugins.hosts.seams import Seam, SeamCall
from fragprune_plugins.hosts.source import HostRepo
from fragprune_plugins.learning.events import PopulationChange
from fragprune_plugins.learning.schedule import Schedule, Settings
from fragprune_plugins.learning.stage2 import Stage2
from fragprune_plugins.learning.thresholds import ThresholdStore
from fragprune_plugins.plugins import hookspecs
from fragprune_plugins.plugins.hooks import engine_for, schedule_for, thresholds_for
from fragprune_plugins.plugins.loading import Plugins
from fragprune_plugins.reprs import one_line
from fragprune_plugins.storage import sidecar
from fragprune_plugins.types import RasterInputs

log = logging.getLogger("fragprune")


@dataclass
class ModelState:
    """A model's thresholds and everything that is known of its training.

    Attributes:
        store: its thresholds.
        stage: that learns them; None where those of a sidecar are only applied.
        steps: of the host, from the first that was seen.
    """

    store: ThresholdStore
    stage: Stage2 | None = None
    steps: int = 0
    begun: bool = False  # a step whose loss has not gone backward yet
    pending_parents: Tensor | None = None
    prepared: bool = False
    views: dict[int, Callable[[], Any]] = field(default_factory=dict)  # view -> its last render
    loaded: weakref.ReferenceType[Any] | None = None  # the means a sidecar's thresholds came with
    hooked: weakref.WeakSet[Any] = field(default_factory=weakref.WeakSet)
    hooks: list[Any] = field(default_factory=list)
    stepped: int = -1
    lent: list[list[tuple[dict[str, Any], float]]] = field(default_factory=list)  # the host's rates

    __repr__ = one_line


class SessionState:
    """How one host is followed in this process, and the models that it trains.

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
        self.engine_name = engine
        self.engines: dict[torch.device, Engine] = {}
        self.drop_in = drop_in
        self.dialect = adapter.dialect(repo)
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

    def engine(self, device: torch.device) -> Engine:
        """The engine for tensors on a device, created at its first use there."""
        if device not in self.engines:
            engine = engine_for(self.engine_name, device, self.plugins)
            if engine.name == "reference":
                log.warning(
                    "drawing on %s with the reference engine: exact, and slow; "
                    "fragprune doctor says why no faster one is used",
                    device,
                )
            self.engines[device] = engine
        return self.engines[device]

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
        begun = self.from_step == 0 or (state is not None and state.steps > self.from_step)
        return self.learn and self.freeze and begun

    def groups(self, model: Any) -> list[tuple[str | None, dict[str, Any]]]:
        """Param groups of every optimizer, the main one's first, with the adapter's names."""
        known = (each() for each in self.optimizers.get(model, ()))
        optimizers = [optimizer for optimizer in known if optimizer is not None]
        groups = [group for optimizer in optimizers for group in optimizer.param_groups]
        return [(self.adapter.group_name(model, group), group) for group in groups]

    def follow(self, model: Any, state: ModelState) -> None:
        """This model is the one that reports and summaries are about."""
        self.last, self.last_state = weakref.ref(model), state

    def truncate(self, inputs: RasterInputs, store: ThresholdStore) -> Tensor | None:
        """The thresholds that plugins apply to one rasterization."""
        return thresholds_for(inputs, store, self.plugins)

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
        means = self.adapter.means(model)
        store, _ = sidecar.load(path, self.adapter.rows(model), means.device)
        state = self.models[model] = ModelState(store, loaded=weakref.ref(means))
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
