"""Stage 2 without a host: drives the learning over the photographs of a data set."""

from __future__ import annotations

import random
import signal
import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import astuple, dataclass, replace
from functools import partial
from itertools import islice
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from fragprune_plugins.engines import Engine
from fragprune_plugins.engines.losses import code_for, photometric_loss
from fragprune_plugins.errors import CheckpointError, UsageError
from fragprune_plugins.files.model import Model
from fragprune_plugins.learning.adam import make_adam
from fragprune_plugins.learning.area import area_per_pixel
from fragprune_plugins.learning.events import StepStats
from fragprune_plugins.learning.interruption import Terminate, Waiting, between_steps
from fragprune_plugins.learning.schedule import Schedule, Settings
from fragprune_plugins.learning.stage2 import FrameClock, Progress, Stage2
from fragprune_plugins.learning.thresholds import ThresholdStore
from fragprune_plugins.plugins import hookspecs
from fragprune_plugins.plugins.hooks import engine_for, schedule_for, thresholds_for
from fragprune_plugins.plugins.loading import installed
from fragprune_plugins.reprs import one_line
from fragprune_plugins.types import RasterInputs, RasterOutputs
from fragprune_plugins.workbench.distributed.processes import expect_divisible, processes_of
from fragprune_plugins.workbench.finetune.checkpoints import UNFIT
from fragprune_plugins.workbench.finetune.resuming import Checkpoints, configuration
from fragprune_plugins.workbench.finetune.timing import require_reach, times_faster
from fragprune_plugins.workbench.models import model as models
from fragprune_plugins.workbench.prices.cost import Cost, work_of
from fragprune_plugins.workbench.ranks import Ranks
from fragprune_plugins.workbench.scenes.dataset import Dataset, Shot

# Learning rates at the start of stage 2, the hosts' own; all decay with the opacity's. Positions
# (times the scene's extent) take a tenth of the hosts' first: a tenth of that held out less, and a
# tenth of these rates for shapes cut fewer fragments at no better PSNR.
_APPEARANCE = {"f_dc": 0.0025, "f_rest": 0.0025 / 20}
_GEOMETRY = {"xyz": 1.6e-5, "scaling": 0.005, "rotation": 0.001}
_SIGNALS = (signal.SIGINT, signal.SIGTERM)
_MOMENTS = ("exp_avg", "exp_avg_sq")
_OF_VIEWS = {"before", "after"}  # of stage 2's tensors; all others have a row for each Gaussian
_POSTFIXES = 100  # times in a run that the bar says how it goes
_COMPARE = 100  # steps from one comparison of replicas to the next


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

    __repr__ = one_line


def finetune(
    model: Model | models.Trained | str | Path,
    dataset: Dataset,
    settings: Settings | None = None,
    *,
    schedule: Schedule | None = None,
    rule: Callable[[Tensor], Tensor] | None = None,
    cost: Cost | None = None,
    engine: str | Engine = "auto",
    progress: bool = False,
    checkpoints: Checkpoints | None = None,
    ranks: Ranks | None = None,
) -> FinetuneResult:
    """Learn the thresholds of a trained splat on its photographs; portable, its shapes.

    Loss: 0.8 L1 + 0.2 (1 - SSIM) + pressure x drawn fragments per pixel; portable, pressure x
    area of the ellipses per pixel. Views come in seeded
    random permutations; the global random streams are not touched.

    Args:
        model: what ``load`` gave, the result of another fine-tuning, or a file; not changed.
            Learning begins with its thresholds, or with neutral ones. Everything happens on its
            device.
        dataset: its photographs; only training views are learned from. Pixels stay in main memory
            and follow the model one view at a time.
        settings: iterations, what moves, pressure or target; defaults when None.
        schedule: gives the plan of each step; when None a plugin's, or the default one.
        rule: gives thresholds (N,) from activated opacities (N,), instead of learning: in the steps
            that would learn, views are drawn with them. They get no gradient, and nothing presses
            on fragments: the settings' pressure and target have no effect.
        cost: prices of the engine on this machine; a target time needs them.
        engine: a name or an engine.
        progress: draw a bar on stderr.
        checkpoints: where the unfinished fine-tuning is kept. If there is one of the same
            configuration, this goes on from it; on the cpu engine the result is then the same to
            the bit. Whoever saves the result clears them.
        ranks: the processes that learn together (``ranks.joined``), each of which calls this with
            equal arguments and gets the same result; only the first writes checkpoints, draws the
            bar and tells observers. This one alone when None. With a ``ShardedEngine`` each passes
            its own Gaussians, and gets those back (``processes.part_of``, ``whole_of``).

    Raises:
        EngineError: no such engine here.
        CheckpointError: the checkpoint is broken, or another fine-tuning's.
        PluginError: a plugin raised, or gave an answer that cannot be used.
        UsageError: a target time without prices, or one that no thresholds reach; portable with
            thresholds, the model's or by a rule; a target time, or views that cannot be divided,
            in several processes.
        RanksError: another process is gone, or differs.
        DivergedError: NaN or infinity in what trains.
    """
    ranks, model = ranks or Ranks(), models.of(model)
    settings, device = settings or Settings(), model.device
    if rule is not None:
        settings = replace(
            settings, pressure=0.0, target_speedup=None, target_time=None, truncate=True
        )
    engine = engine_for(engine, device) if isinstance(engine, str) else engine
    dataset = dataset.to(device)
    if settings.portable and (rule is not None or model.pruned):
        raise UsageError(
            "finetune",
            "portable, and thresholds or a stop to draw with",
            "a model without any: it is for viewers that know none",
            "Pass --no-truncation to ignore thresholds stored with the model.",
        )
    expect_divisible(settings, engine, ranks)
    run = _Run(
        model,
        dataset,
        settings,
        schedule or schedule_for(settings),
        rule,
        cost,
        engine,
        ranks,
    )
    run.start_keeping(checkpoints)
    resumed, interrupted, terminated = run.done, False, False
    try:
        run.learn(progress and ranks.first)
    except KeyboardInterrupt as error:
        if run.processes.sharded and not run.between:
            raise  # a second signal did not wait for the others, who hold the other parts
        interrupted, terminated = True, isinstance(error, Terminate)
        if run.between:
            run.keep()
    run.stage.check()
    return FinetuneResult(
        model=run.result_model(),
        settings=settings,
        curves=run.curves,
        progress=replace(
            run.stage.progress(), steps=run.done, gaussians=run.processes.total(len(model))
        ),
        train_seconds=run.seconds,
        engine=run.engine.name,
        interrupted=interrupted,
        terminated=terminated,
        resumed_at=resumed,
    )


@torch.no_grad()
def mean_fragments(model: Model, shots: Sequence[Shot], engine: Engine) -> float:
    """Drawn fragments per pixel, averaged over views."""
    splats = model.splats()
    total = 0.0
    for shot in shots:
        inputs = RasterInputs(shot.view, splats, planes=(), stop=model.stop)
        outputs = engine.rasterize(inputs, model.falloff)
        total += float(outputs.fragments_per_pixel)
    return total / len(shots)


class _Run:
    """One fine-tuning under way: drives stage 2 over the photographs of a data set."""

    def __init__(
        self,
        model: Model,
        dataset: Dataset,
        settings: Settings,
        schedule: Schedule,
        rule: Callable[[Tensor], Tensor] | None,
        cost: Cost | None,
        engine: Engine,
        ranks: Ranks,
    ) -> None:
        self.dataset, self.settings, self.engine = dataset, settings, engine
        self.ranks, self.processes = ranks, processes_of(engine, ranks, len(model))
        self.start, self.rule = model, rule
        clock = None
        if settings.target_time is not None and cost is not None:
            require_reach(settings.target_time, cost, model, dataset.train, engine)
            clock = FrameClock(
                lambda outputs: cost.ms(work_of(outputs)),
                lambda shots: times_faster(
                    model, self.result_model(), self.stage.thresholds, shots, engine
                ),
            )
        self.others: dict[str, Any] = {
            "rule": None if rule is None else getattr(rule, "name", repr(rule)),
            "prices": dict(cost.prices) if clock and cost else None,  # times were predicted by them
            "loss": code_for(model.xyz.device),
        }
        self.curves: list[StepStats] = []
        self.done, self.between = 0, True
        self.ending = True  # a signal may end the run after this step
        self.due = False  # it is time for a checkpoint, some process says
        self.new = False  # a view of this step is drawn for the first time, here or elsewhere
        self._started = time.perf_counter()
        self.checkpoints: Checkpoints | None = None
        known = model.thresholds if settings.truncate else None
        store = ThresholdStore(len(model), model.device) if known is None else known.clone()
        again = {shot: partial(self._draw, shot) for shot in dataset.train}
        self.stage = Stage2(
            store,
            settings,
            schedule,
            truncate=thresholds_for if rule is None else self._ruled,
            views=again,
            watch=self._watched,
            parameters=lambda: {name: getattr(self.model, name) for name in self.rates},
            clock=clock,
            everywhere=self.processes.everywhere,
        )
        rates = {"opacity": settings.opacity_lr}
        if settings.train in ("appearance", "all"):
            rates |= _APPEARANCE
        if settings.train == "all":
            rates |= _GEOMETRY | {"xyz": _GEOMETRY["xyz"] * dataset.extent}
        parameters = {
            name: getattr(model, name)
            .detach()
            .clone(memory_format=torch.contiguous_format)
            .requires_grad_(True)
            for name in rates
        }
        self.model = replace(model, **parameters, thresholds=None)
        self.rates = {name: rate * settings.rate for name, rate in rates.items()}
        self.optimizer = make_adam(
            [{"params": [each], "lr": self.rates[name]} for name, each in parameters.items()]
        )

    def result_model(self) -> Model:
        """The model as learned, free of gradients."""
        learned: dict[str, Any] = {n: getattr(self.model, n).detach() for n in self.rates}
        model = replace(self.model, **learned, thresholds=self.stage.store)
        return model if model.pruned else model.untruncated()

    @property
    def seconds(self) -> float:
        """Wall-clock seconds of all steps, also of those before a checkpoint."""
        return time.perf_counter() - self._started

    def start_keeping(self, checkpoints: Checkpoints | None) -> None:
        """Go on from a checkpoint, if there is one, and write one from time to time.

        Several processes see first whether they were asked for the same.
        """
        if checkpoints is None and not self.ranks.several:
            return
        self.asked = configuration(
            self.start, self.dataset, self.settings, self.engine.name, self.stage.schedule
        )
        self.asked = self.processes.described(self.asked) | self.others
        del self.asked["nonfinite"]  # a run that such a step stopped may go on and skip it
        if checkpoints is not None:
            self._go_on(checkpoints)
        known = {**self.asked, "checkpoint": self.done, "torch": torch.__version__}
        self.ranks.agree(known, "fine-tuning, before its first step")

    def _go_on(self, checkpoints: Checkpoints) -> None:
        """Take over what a checkpoint holds, if there is one; the first process writes the next."""
        self.checkpoints = checkpoints if self.ranks.first else None
        device = "cpu" if self.processes.sharded else self.start.device
        tensors, values = checkpoints.load(self.asked, device)
        if not values:
            return
        try:
            self._load(tensors, values)
        except UNFIT as error:
            raise CheckpointError(
                str(checkpoints.path),
                f"parts that do not fit together ({error})",
                "what a fine-tuning wrote",
                "Begin anew with --again.",
            ) from error
        checkpoints.tell(
            f"resuming at step {self.done} of {self.settings.iterations}, from {checkpoints.path}"
        )
        if values["threads"] != torch.get_num_threads():
            checkpoints.tell(
                f"it was begun on {values['threads']} threads, and goes on on "
                f"{torch.get_num_threads()}: the last bits of the result may differ"
            )

    def keep(self) -> None:
        """Write a checkpoint, between two steps."""
        mine = self.checkpoints is not None or self.processes.sharded
        if not mine or not self.optimizer.state:  # no step was taken
            return
        self.stage.check()
        tensors, values = self.stage.state_dict()
        for name in self.rates:
            parameter = getattr(self.model, name)
            tensors[f"model.{name}"] = parameter
            moments = self.optimizer.state[parameter]
            for moment in _MOMENTS:
                tensors[f"{moment}.{name}"] = moments[moment]
        for name in sorted(tensors.keys() - _OF_VIEWS):  # in the same order in all processes
            tensors[name] = self.processes.whole(tensors[name])
        if self.checkpoints is None:  # the first process writes
            return
        points = [astuple(point) for point in self.curves]
        tensors["curves"] = torch.tensor(points, dtype=torch.float64).reshape(len(points), -1)
        values |= {
            "configuration": self.asked,
            "done": self.done,
            "adam_step": float(moments["step"]),
            "seconds": self.seconds,
            "threads": torch.get_num_threads(),
        }
        self.checkpoints.save(tensors, values)

    def _load(self, tensors: dict[str, Tensor], values: dict[str, Any]) -> None:
        for name in tensors.keys() - _OF_VIEWS - {"curves"}:
            tensors[name] = self.processes.own(tensors[name])
        self.stage.load_state_dict(tensors, values)
        if len(self.stage.store) != len(self.model):
            raise ValueError(f"{len(self.stage.store)} thresholds of {len(self.model)} Gaussians")
        adam_step, seconds = values["adam_step"], values["seconds"]
        if min(adam_step, seconds) < 0:
            raise ValueError(f"{adam_step} steps in {seconds} seconds")
        for name in self.rates:
            parameter = getattr(self.model, name)
            parameter.data.copy_(tensors[f"model.{name}"])
            step = torch.tensor(float(adam_step), dtype=torch.float32)
            state: dict[str, Tensor] = {"step": step}
            for moment in _MOMENTS:
                state[moment] = torch.empty_like(parameter).copy_(tensors[f"{moment}.{name}"])
            self.optimizer.state[parameter] = state
        for row in tensors["curves"].tolist():
            self.curves.append(StepStats(int(row[0]), *row[1:]))
        self.done = int(values["done"])
        if not 0 <= self.done == self.stage.steps <= self.settings.iterations:
            raise ValueError(f"{self.done} steps, of which the thresholds took {self.stage.steps}")
        self._started -= seconds

    def learn(self, progress: bool) -> None:
        """All steps that are not done yet."""
        from tqdm import tqdm

        total = self.settings.iterations
        with (
            tqdm(
                total=total,
                initial=self.done,
                disable=not progress,
                desc="fine-tuning",
                unit="it",
                leave=None,
            ) as bar,
            between_steps() as waiting,
        ):
            for shots in islice(self._order(), self.done, None):
                self.between = False
                self._learn_from(shots, waiting)
                self.between = True
                if self.ending:
                    waiting()
                if self.due if self.ranks.several else self._due(self.done):
                    self.keep()
                bar.update()
                if self.curves and self.done % max(1, total // _POSTFIXES) == 0:
                    views = len(self.dataset.train)  # they differ more than steps do
                    last = self.curves[-max(1, views // self.settings.views_per_step) :]
                    loss, drawn = (
                        sum(getattr(point, name) for point in last) / len(last)
                        for name in ("loss", "fragments_per_pixel")
                    )
                    bar.set_postfix(loss=f"{loss:.4f}", fragments=f"{drawn:.1f}/px")
        self.stage.close()
        if self.ranks.several:
            self._compare()
        if self.rule is not None:
            self._follow(self.rule, torch.sigmoid(self.model.opacity[:, 0].detach()))

    def _watched(self, stats: StepStats) -> None:
        """Keep a finished step for the curves, and tell observers."""
        self.curves.append(stats)
        if self.ranks.first:
            installed().tell(hookspecs.fragprune_step, stats=stats)

    def _follow(self, rule: Callable[[Tensor], Tensor], opacities: Tensor) -> None:
        """Put what the rule gives for these opacities (N,) into the store."""
        self.stage.store.place(torch.logit(rule(opacities)))

    def _ruled(self, inputs: RasterInputs, store: ThresholdStore) -> Tensor | None:
        """The rule's thresholds for the opacities as they are now; None before thresholds open."""
        if self.rule is None or not self.stage.learning:
            return None
        self._follow(self.rule, inputs.splats.opacities.detach())
        return store.values.detach()

    def _order(self) -> Iterator[Sequence[Shot]]:
        """For each step its views, from permutations of all training views one after the other."""
        stream = random.Random(self.settings.seed)
        queue: list[Shot] = []
        for _ in range(self.settings.iterations):
            shots: list[Shot] = []
            for _ in range(self.settings.views_per_step):
                if not queue:
                    queue = list(self.dataset.train)
                    stream.shuffle(queue)
                shots.append(queue.pop())
            yield shots

    def _learn_from(self, shots: Sequence[Shot], waiting: Waiting) -> None:
        stage = self.stage
        stage.begin(lambda: torch.sigmoid(self.model.opacity.detach()))
        self.new = not all(map(stage.knows, shots))
        for shot in self.ranks.share(shots):
            stage.picture = shot.name
            outputs, pressure = self._draw(shot)
            loss = photometric_loss(shot.looked_at(outputs.image), shot.image) / len(shots)
            stage.lost(loss)
            torch.autograd.backward(loss if pressure is None else loss + pressure)
        stage.picture = ", ".join(shot.name for shot in shots)
        if self.ranks.several:
            self._exchange(shots, waiting)
        rates = self.rates.items()
        for group, (name, base) in zip(self.optimizer.param_groups, rates, strict=True):
            group["lr"] = stage.rate(name, base)
        gradients = {name: getattr(self.model, name).grad for name in self.rates}
        if not stage.sound({name: each for name, each in gradients.items() if each is not None}):
            self.optimizer.zero_grad(set_to_none=True)
        self.optimizer.step()
        self.optimizer.zero_grad(set_to_none=True)
        stage.end()
        self.done += 1
        if self.ranks.several and self.done % _COMPARE == 0:
            self._compare()

    def _compare(self) -> None:
        """Stop if processes have parted."""
        tensors = {name: getattr(self.model, name) for name in self.rates}
        self.processes.compare(tensors | {"thresholds": self.stage.store.logits}, self.done)

    @torch.no_grad()
    def _exchange(self, shots: Sequence[Shot], waiting: Waiting) -> None:
        """Take over from all processes gradients and figures; and whether to end, or to keep."""
        leaves = [*(getattr(self.model, name) for name in self.rates), self.stage.store.logits]
        flags = [*(waiting.number == number for number in _SIGNALS), self._due(self.done + 1)]
        rows = self.stage.figures()
        table, (*signals, self.due) = self.processes.exchange(leaves, rows, len(shots), flags)
        if rows:
            self.stage.share(shots, table)
        came = [number for number, some in zip(_SIGNALS, signals, strict=True) if some]
        self.ending = bool(came)  # one that comes later waits for the next exchange
        if came and not waiting.number:
            signal.raise_signal(came[0])  # it came to another process: all end after this step

    def _due(self, step: int) -> bool:
        """Whether it is time for a checkpoint after a step."""
        return self.checkpoints is not None and self.checkpoints.due(step)

    def _draw(self, shot: Shot) -> tuple[RasterOutputs, Tensor | None]:
        """Draw a view with its thresholds; also return the pressure."""
        stop = self.stage.store.stop
        inputs = RasterInputs(shot.view, self.model.splats(), planes=(), stop=stop)
        thresholds = self.stage.thresholds(inputs)

        outputs, plain = self.engine.rasterize(inputs, thresholds), None
        if self.new and self.processes.sharded:  # another process may need it, and all draw then
            plain = self._plain(inputs)

        def untruncated() -> RasterOutputs:
            whole = thresholds is None and stop is None
            return outputs if whole else plain or self._plain(inputs)

        area = area_per_pixel(inputs) if self.settings.portable else None
        return outputs, self.stage.drew(shot, outputs, untruncated, area=area)

    @torch.no_grad()
    def _plain(self, inputs: RasterInputs) -> RasterOutputs:
        """Draw without thresholds and stop."""
        return self.engine.rasterize(replace(inputs, stop=None), None)
