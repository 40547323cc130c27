"""The loop of a fine-tuning without a host: it drives stage 2 over the views of a data set."""

from __future__ import annotations

import contextlib
import random
import statistics
import time
from collections.abc import Iterator, Sequence
from dataclasses import astuple, dataclass, replace
from functools import partial
from itertools import islice
from typing import Any

import torch
from torch import Tensor
from tqdm import tqdm

from fragprune_plugins.engines import Engine
from fragprune_plugins.errors import CheckpointError
from fragprune_plugins.files.model import Model
from fragprune_plugins.learning.adam import EPSILON, stepping_fused
from fragprune_plugins.learning.area import area_per_pixel
from fragprune_plugins.learning.deferred import DeferredSignals, between_steps
from fragprune_plugins.learning.events import Progress, StepStats
from fragprune_plugins.learning.schedule import Schedule, Settings
from fragprune_plugins.learning.thresholds import MOMENTS, ThresholdStore
from fragprune_plugins.plugins import hookspecs
from fragprune_plugins.plugins.hooks import drawn_by, thresholds_for
from fragprune_plugins.plugins.loading import installed
from fragprune_plugins.types import RasterInputs, RasterOutputs, one_line
from fragprune_plugins.workbench.finetune.faster import FrameTarget, require_reach
from fragprune_plugins.workbench.finetune.losses import code_for, photometric_loss
from fragprune_plugins.workbench.finetune.processes import Processes, SharedStage
from fragprune_plugins.workbench.finetune.relocation import Relocation, deepen, price
from fragprune_plugins.workbench.finetune.resuming import Checkpoints, configuration
from fragprune_plugins.workbench.goals import Faster
from fragprune_plugins.workbench.scenes.dataset import Dataset, Shot

# Learning rates at the start of stage 2, the hosts' own; all decay with the opacity's. Positions
# (times the scene's extent) take a tenth of the hosts' first: a tenth of that held out less, and a
# tenth of these rates for shapes cut fewer fragments at no better PSNR.
_APPEARANCE = {"f_dc": 0.0025, "f_rest": 0.0025 / 20}
_GEOMETRY = {"xyz": 1.6e-5, "scaling": 0.005, "rotation": 0.001}
LIVELY = 4.0
"""Times these rates where photographs teach all of a model with dropout, or where Gaussians move:
docs/experiments/defaults.md. Its own pictures teach worse so: 29.75 dB in place of 29.89 on fox
(--self --dropout 0.2)."""
_POSTFIXES = 100  # times in a run that the bar says how it goes

_OF_VIEWS = {"before", "after"}  # of stage 2's tensors; all others have a row for each Gaussian


@dataclass(frozen=True, eq=False)
class FinetuneResult:
    """Result of a fine-tuning.

    Attributes:
        model: the Gaussians with what they learned; what ``train`` did not name is the very tensor
            that came in. A control and a portable model have no thresholds.
        settings: of the fine-tuning.
        curves: one point per step.
        progress: steps done, fragments before and after on the training views, the target.
        train_seconds: wall-clock seconds of the loop.
        engine: the engine's name.
        interrupted: Ctrl-C or SIGTERM ended it early; the result is what was learned until then.
        terminated: SIGTERM ended it.
        resumed_at: steps that came out of a checkpoint; 0 without one.
        relocated: Gaussians that moved to where some were missing.
    """

    model: Model
    settings: Settings
    curves: Sequence[StepStats]
    progress: Progress
    train_seconds: float
    engine: str
    interrupted: bool
    terminated: bool
    resumed_at: int = 0
    relocated: int = 0

    __repr__ = one_line


class Training:
    """One fine-tuning under way.

    Args:
        start: the model as it comes in; not changed.
        dataset: on the model's device.
        checkpoints: from which it goes on, if there is one, and where the next ones go.
        relocate: (M,) int64, the rows of Gaussians that move to where some are missing, the one
            worth least first; see ``Relocation``.

    Attributes:
        model: as it is now; what trains has gradients.
        rates: initial learning rates of the parameters that train, by name.
        done: steps.
        between: no step is under way.
        started: ``time.perf_counter()`` at its start, minus what was trained before a checkpoint.
    """

    def __init__(
        self,
        start: Model,
        dataset: Dataset,
        settings: Settings,
        schedule: Schedule,
        engine: Engine,
        processes: Processes,
        checkpoints: Checkpoints | None = None,
        relocate: Tensor | None = None,
    ) -> None:
        self.start, self.dataset, self.settings = start, dataset, settings
        self.engine, self.processes = engine, processes
        self.curves: list[StepStats] = []
        self.done, self.between = 0, True
        self.started = time.perf_counter()
        goal = settings.goal
        known = start.thresholds if goal.presses else None
        target = None
        if isinstance(goal, Faster):
            require_reach(goal.ratio, start, dataset.train, engine)
            target = FrameTarget(goal.ratio, self)
        self.stage = SharedStage(
            ThresholdStore(len(start), start.device) if known is None else known.clone(),
            settings,
            schedule,
            truncate=thresholds_for,
            views={shot: partial(self._draw, shot) for shot in dataset.train},
            watch=self._watched,
            parameters=self.parameters,
            target=target,
            everywhere=processes.everywhere,
        )
        self.relocation = None
        rates = rates_of(settings, dataset.extent, moves=relocate is not None)
        if relocate is not None:
            self.relocation = Relocation(relocate, start.scaling, settings.iterations)
            rates["xyz"] = self.relocation.rate
            deepen(self.stage.pressure)
        leaves: dict[str, Any] = {
            name: getattr(start, name)
            .detach()
            .clone(memory_format=torch.contiguous_format)
            .requires_grad_(True)
            for name in rates
        }
        self.model = replace(start, **leaves, thresholds=None)
        self.rates = {name: rate * settings.rate for name, rate in rates.items()}
        groups = [{"params": [leaf], "name": name} for name, leaf in leaves.items()]
        self.optimizer = torch.optim.Adam(groups, eps=EPSILON)
        self._plain_first = False  # a view of this step is drawn for the first time somewhere
        self._checkpoints = checkpoints if processes.first else None  # which writes them
        if checkpoints is not None or processes.ranks.several:
            self._go_on(checkpoints)

    def _go_on(self, checkpoints: Checkpoints | None) -> None:
        """Take over what a checkpoint holds, if there is one, in all processes."""
        processes, device = self.processes, self.start.device
        given = self.start, self.dataset, self.settings, self.engine.name
        asked = configuration(*given, self.stage.schedule)
        if processes.divided:  # digests of all parts
            names = ("model", "thresholds")
            asked |= {name: processes.ranks.gather(asked[name]) for name in names}
        moves = None if self.relocation is None else self.relocation.moved(self.settings.iterations)
        self._configuration = asked | {"loss": code_for(device), "moves": moves}
        if checkpoints is not None:
            where = "cpu" if processes.divided else device
            tensors, values = checkpoints.load(self._configuration, where)
            if values:
                try:
                    self._load_state_dict(tensors, values)
                except Exception as error:  # as of any file that somebody else may have written
                    raise CheckpointError(
                        str(checkpoints.path),
                        f"parts that do not fit together ({error})",
                        "what a fine-tuning wrote",
                        "Begin anew with --again.",
                    ) from error
                checkpoints.tell_of(self.done, self.settings.iterations, values["threads"])
        versions = {"checkpoint": self.done, "torch": torch.__version__}
        processes.ranks.agree(self._configuration | versions, "fine-tuning, before its first step")

    def keep(self) -> None:
        """Write a checkpoint, between two steps; all processes, if each has a part of it."""
        mine = self._checkpoints is not None or self.processes.divided
        if not mine or not self.optimizer.state:  # no step was taken
            return
        self.stage.check()
        tensors, values = self._state_dict()
        if self._checkpoints is not None:
            self._checkpoints.save(tensors, values | {"configuration": self._configuration})

    def _state_dict(self) -> tuple[dict[str, Tensor], dict[str, Any]]:
        """Tensors and plain values, for ``_load_state_dict``; the first process has all rows."""
        tensors, values = self.stage.state_dict()
        for name, parameter in self.parameters().items():
            tensors[f"model.{name}"] = parameter
            moments = self.optimizer.state[parameter]
            for moment in MOMENTS:
                tensors[f"{moment}.{name}"] = moments[moment]
        for name in sorted(tensors.keys() - _OF_VIEWS):  # in the same order in all processes
            tensors[name] = self.processes.whole(tensors[name])
        if self.relocation is not None:
            tensors["pull"] = self.relocation.pull
        points = [astuple(point) for point in self.curves]
        tensors["curves"] = torch.tensor(points, dtype=torch.float64).reshape(len(points), -1)
        return tensors, values | {
            "done": self.done,
            "adam_step": float(moments["step"]),
            "seconds": self.seconds,
            "threads": torch.get_num_threads(),
        }

    def _load_state_dict(self, tensors: dict[str, Tensor], values: dict[str, Any]) -> None:
        """Take over what ``_state_dict`` gave; raises anything if its parts do not fit."""
        stage = self.stage
        if self.relocation is not None:
            self.relocation.pull.copy_(tensors.pop("pull"))
        for name in tensors.keys() - _OF_VIEWS - {"curves"}:
            tensors[name] = self.processes.own(tensors[name])
        stage.load_state_dict(tensors, values)
        if len(stage.store) != len(self.model):
            raise ValueError(f"{len(stage.store)} thresholds of {len(self.model)} Gaussians")
        for name, parameter in self.parameters().items():
            parameter.data.copy_(tensors[f"model.{name}"])
            step = torch.tensor(float(values["adam_step"]), dtype=torch.float32)
            moments = {
                moment: torch.empty_like(parameter).copy_(tensors[f"{moment}.{name}"])
                for moment in MOMENTS
            }
            self.optimizer.state[parameter] = {"step": step, **moments}
        self.curves += [StepStats(int(step), *row) for step, *row in tensors["curves"].tolist()]
        self.done = int(values["done"])
        if not 0 <= self.done == stage.steps <= self.settings.iterations:
            raise ValueError(f"{self.done} steps, of which the thresholds took {stage.steps}")
        self.started -= values["seconds"]

    def parameters(self) -> dict[str, Tensor]:
        """What trains beside the thresholds, by name."""
        return {name: getattr(self.model, name) for name in self.rates}

    def result_model(self) -> Model:
        """The model as learned, free of gradients."""
        learned: dict[str, Any] = {n: each.detach() for n, each in self.parameters().items()}
        model = replace(self.model, **learned, thresholds=self.stage.store)
        return model if model.pruned else model.untruncated()

    def end(self) -> None:
        """Free what steps alone need: moments, and stage 2, whose views hold this in a cycle."""
        del self.optimizer, self.stage

    @property
    def relocated(self) -> int:
        """Gaussians that have moved."""
        return 0 if self.relocation is None else self.relocation.moved(self.done)

    @property
    def seconds(self) -> float:
        """Wall-clock seconds of all steps, also of those before a checkpoint."""
        return time.perf_counter() - self.started

    def learn(self, progress: bool) -> None:
        """All steps that are not done yet; with ``progress`` there is a bar on stderr."""
        settings, total = self.settings, self.settings.iterations
        steps = order(self.dataset.train, total, settings.views_per_step, settings.seed)
        bar = tqdm(
            desc="fine-tuning", total=total, initial=self.done, leave=None, disable=not progress
        )
        with bar, stepping_fused(), between_steps() as waiting:
            for shots in islice(steps, self.done, None):
                self.between = False
                self._step(shots, waiting)
                self.between = True
                if self.processes.may_end:
                    waiting()
                if self.processes.due:
                    self.keep()
                bar.update()
                if self.curves and self.done % max(1, total // _POSTFIXES) == 0:
                    warming = self.stage.warming_up
                    bar.set_description("warm-up" if warming else "fine-tuning", refresh=False)
                    bar.set_postfix(**self._how_it_goes())
        self.stage.close()
        self.processes.stepped(self._learned(), self.done, last=True)

    def _how_it_goes(self) -> dict[str, str]:
        """Means over as many steps as see all views: these differ more than steps do."""
        last = self.curves[-max(1, len(self.dataset.train) // self.settings.views_per_step) :]
        loss = statistics.fmean(point.loss for point in last)
        drawn = statistics.fmean(point.fragments_per_pixel for point in last)
        return {"loss": f"{loss:.4f}", "fragments": f"{drawn:.1f}/px"}

    def _watched(self, stats: StepStats) -> None:
        """Keep a finished step for the curves, and tell observers."""
        self.curves.append(stats)
        if self.processes.first:
            installed().tell(hookspecs.fragprune_step, stats=stats)

    def _learned(self) -> dict[str, Tensor]:
        """All that learns, by name."""
        return {**self.parameters(), "thresholds": self.stage.store.logits}

    def _step(self, shots: Sequence[Shot], waiting: DeferredSignals) -> None:
        stage = self.stage
        stage.begin(lambda: torch.sigmoid(self.model.opacity.detach()))
        self._plain_first = not all(map(stage.knows, shots))
        for shot in self.processes.ranks.share(shots):
            stage.picture = shot.name
            outputs, pressure, area = self._draw(shot)
            loss = photometric_loss(shot.looked_at(outputs.image), shot.image) / len(shots)
            stage.on_loss(loss)
            if area is not None:
                loss = loss + price(loss, area)
            torch.autograd.backward(loss if pressure is None else loss + pressure)
        stage.picture = ", ".join(shot.name for shot in shots)
        due = self._checkpoints is not None and self._checkpoints.due(self.done + 1)
        self.processes.went_backward(stage, self._learned(), shots, waiting, due=due)
        for group in self.optimizer.param_groups:
            group["lr"] = stage.rate(group["name"], self.rates[group["name"]])
        stage.expect_sound()
        moving: Any = contextlib.nullcontext()
        if self.relocation is not None:
            of = self.parameters(), stage.store, self.optimizer.state
            moving = self.relocation.stepping(self.done + 1, *of)
        with moving:
            self.optimizer.step()
        self.optimizer.zero_grad(set_to_none=True)
        stage.end()
        self.done += 1
        self.processes.stepped(self._learned(), self.done)

    @property
    def _compacts(self) -> bool:
        """Whether area has a price in this step, beside fragments."""
        moving = self.relocation is not None and not self.relocation.over(self.done + 1)
        return moving and self.settings.goal.learns and self.start.scaling.shape[1] == 3

    def _draw(self, shot: Shot) -> tuple[RasterOutputs, Tensor | None, Tensor | None]:
        """Draw a view with its thresholds; also the pressure, and the area where it has a price."""
        rules = self.stage.store.rules
        splats = self.model.splats(sh_apart=getattr(self.engine, "sh_apart", False))
        inputs = RasterInputs(shot.view, splats, planes=(), **rules)
        thresholds = self.stage.thresholds(inputs)

        shown = self.stage.dropped(inputs)
        outputs, plain = drawn_by(self.engine, shown, thresholds), None
        if self._plain_first and self.processes.divided:  # another may need it, and all draw then
            plain = self._plain(inputs)

        def untruncated() -> RasterOutputs:
            whole = thresholds is None and inputs.stop is None and shown is inputs
            return outputs if whole else plain or self._plain(inputs)

        on_area = self.settings.goal.on_area
        area = area_per_pixel(inputs) if on_area or self._compacts else None
        pressed, priced = (area, None) if on_area else (None, area)
        return outputs, self.stage.on_drawn(shot, outputs, untruncated, area=pressed), priced

    @torch.no_grad()
    def _plain(self, inputs: RasterInputs) -> RasterOutputs:
        """Draw without thresholds and stop."""
        return drawn_by(self.engine, replace(inputs, stop=None), None)


def rates_of(settings: Settings, extent: float, *, moves: bool) -> dict[str, float]:
    """Initial learning rates of the parameters that train, by name, in steps of one view."""
    rates = {"opacity": settings.opacity_lr}
    if settings.train in ("appearance", "all"):
        rates |= _APPEARANCE
    if settings.train == "all":
        rates |= _GEOMETRY | {"xyz": _GEOMETRY["xyz"] * extent}
    dropout = settings.dropout and settings.train == "all" and not settings.itself
    lively = LIVELY if moves or dropout else 1.0
    return {name: rate if name == "opacity" else lively * rate for name, rate in rates.items()}


def order(
    views: Sequence[Shot], steps: int, views_per_step: int, seed: int
) -> Iterator[Sequence[Shot]]:
    """For each step its views, from permutations of all of them, one after the other.

    The global random streams are not touched.
    """
    stream, queue = random.Random(seed), list[Shot]()
    for _ in range(steps):
        while len(queue) < views_per_step:
            again = list(views)
            stream.shuffle(again)
            queue = again + queue
        yield [queue.pop() for _ in range(views_per_step)]
