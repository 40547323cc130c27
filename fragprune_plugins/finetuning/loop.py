"""Stage 2 on its own: opacities and thresholds learn, everything else stays to the bit."""

from __future__ import annotations

import os
import random
import tempfile
import time
from collections import deque
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import torch
from torch import Tensor

from fragprune_plugins.datasets.dataset import Dataset, Shot
from fragprune_plugins.engines import Engine, create_engine
from fragprune_plugins.learning.losses import photometric_loss
from fragprune_plugins.learning.pressure import (
    CALIBRATE_AT,
    CALIBRATION_VIEWS,
    TARGET_TOLERANCE,
    Observation,
    calibrate,
)
from fragprune_plugins.learning.schedule import Schedule, Settings
from fragprune_plugins.learning.thresholds import ThresholdStore
from fragprune_plugins.storage import sidecar
from fragprune_plugins.storage.atomic import replacing, writable_folder
from fragprune_plugins.storage.ply import SplatFile, write_ply
from fragprune_plugins.types import RasterInputs

RECORDS = 100
QUANTILES = (0.05, 0.25, 0.5, 0.75, 0.95)

# Learning rates at the start of stage 2, the hosts' own; all decay with the opacity's. Positions
# (times the scene's extent) take the hosts' last: more gained nothing held out, while a tenth of
# these rates for shapes cut fewer fragments at no better PSNR.
_APPEARANCE = {"f_dc": 0.0025, "f_rest": 0.0025 / 20}
_GEOMETRY = {"xyz": 1.6e-6, "scaling": 0.005, "rotation": 0.001}


@dataclass(frozen=True)
class Record:
    """One point of the curves.

    Attributes:
        step: counted from 1.
        loss: photometric loss, mean over the last pass of the training views.
        fragments_per_pixel: drawn, likewise.
        pressure: lambda at ``step``.
        thresholds: quantiles ``QUANTILES`` over all Gaussians at ``step``.
    """

    step: int
    loss: float
    fragments_per_pixel: float
    pressure: float
    thresholds: tuple[float, ...]


@dataclass(frozen=True, eq=False)
class FinetuneResult:
    """What a fine-tuning gave.

    Attributes:
        model: the Gaussians; what ``train`` did not name is the very tensor that came in.
        store: their thresholds, neutral when truncation was off.
        settings: what was asked.
        records: curves.
        iterations: steps done, fewer than asked when interrupted.
        train_seconds: wall-clock seconds of the loop.
        engine: the engine's name.
        interrupted: Ctrl-C ended it early; what was learned by then is here.
        speedup: fragments before over after on held-out views, before being the untruncated model
            as it came in.
        target_reached: whether ``speedup`` is within 5 % of the target; None without a target.
    """

    model: SplatFile
    store: ThresholdStore
    settings: Settings
    records: Sequence[Record]
    iterations: int
    train_seconds: float
    engine: str
    interrupted: bool
    speedup: float
    target_reached: bool | None

    @property
    def thresholds(self) -> Tensor | None:
        """(N,) to render with; None when neutral."""
        return None if self.store.neutral else self.store.values.detach()


def finetune(
    model: SplatFile,
    dataset: Dataset,
    settings: Settings | None = None,
    *,
    store: ThresholdStore | None = None,
    schedule: Schedule | None = None,
    engine: str | Engine = "auto",
    progress: bool = False,
) -> FinetuneResult:
    """Learn thresholds and opacities of a trained splat on its photographs.

    Loss: 0.8 L1 + 0.2 (1 - SSIM) + pressure x drawn fragments per pixel. Views come in seeded
    random permutations; the global random streams are not touched.

    Args:
        model: the trained splat; not changed.
        dataset: its photographs; only training views are learned from.
        settings: iterations, what moves, pressure or target; defaults when None.
        store: thresholds to go on from, changed in place; neutral ones when None.
        schedule: when what learns how fast; the default one when None.
        engine: a name or an engine.
        progress: draw a bar on stderr.

    Raises:
        EngineError: no such engine here.
        AlignmentError: store and model differ in length.
    """
    settings = settings or Settings()
    run = _Run(
        model,
        dataset,
        settings,
        store or ThresholdStore(len(model)),
        schedule or Schedule(settings),
        create_engine(engine, model.xyz.device) if isinstance(engine, str) else engine,
    )
    started = time.perf_counter()
    interrupted = False
    try:
        run.learn(progress)
    except KeyboardInterrupt:
        interrupted = True
    seconds = time.perf_counter() - started
    learned = run.result_model()
    speedup = 1.0
    if settings.truncate:
        values = run.store.values.detach()
        before = mean_fragments(model, None, dataset.test, run.engine)
        after = mean_fragments(learned, values, dataset.test, run.engine)
        speedup = before / max(after, 1e-9)
    target = settings.target_speedup
    return FinetuneResult(
        model=learned,
        store=run.store,
        settings=settings,
        records=run.records,
        iterations=run.step,
        train_seconds=seconds,
        engine=run.engine.name,
        interrupted=interrupted,
        speedup=speedup,
        target_reached=None if target is None else abs(target / speedup - 1) <= TARGET_TOLERANCE,
    )


@torch.no_grad()
def mean_fragments(
    model: SplatFile, thresholds: Tensor | None, shots: Sequence[Shot], engine: Engine
) -> float:
    """Drawn fragments per pixel, averaged over views."""
    splats = model.splats()
    total = 0.0
    for shot in shots:
        outputs = engine.rasterize(RasterInputs(shot.view, splats), thresholds)
        total += float(outputs.fragments_per_pixel)
    return total / len(shots)


def save(path: Path, result: FinetuneResult) -> Path:
    """Write the model and its sidecar, both complete or neither; returns the sidecar's path.

    Raises:
        OutputError: the place cannot be written; existing files stay as they were.
    """
    path = Path(path)
    folder = writable_folder(path.parent)
    target = sidecar.path_beside(path)
    with tempfile.TemporaryDirectory(dir=folder, prefix=".fragprune-") as scratch:
        model = Path(scratch) / path.name
        write_ply(model, result.model)
        beside = sidecar.save(model, result.store, settings=result.settings.as_dict())
        with replacing(target) as new_sidecar, replacing(path) as new_model:
            os.replace(beside, new_sidecar)
            os.replace(model, new_model)
    return target


class _Run:
    """One fine-tuning under way."""

    def __init__(
        self,
        model: SplatFile,
        dataset: Dataset,
        settings: Settings,
        store: ThresholdStore,
        schedule: Schedule,
        engine: Engine,
    ) -> None:
        self.initial, self.dataset, self.settings = model, dataset, settings
        self.store, self.schedule, self.engine = store, schedule, engine
        self.pressure = settings.make_pressure()
        self.calibration = (
            None if settings.target_speedup is None else CALIBRATE_AT * settings.iterations
        )
        self.step = 0
        self.held = False
        self.records: list[Record] = []
        self._untruncated: dict[str, float] = {}
        # Views differ more than steps do: averages are over one pass of them.
        self._recent: deque[tuple[float, float]] = deque(maxlen=len(dataset.train))

        rates = {"opacity": settings.opacity_lr}
        if settings.train in ("appearance", "all"):
            rates |= _APPEARANCE
        if settings.train == "all":
            rates |= _GEOMETRY | {"xyz": _GEOMETRY["xyz"] * dataset.extent}
        parameters = {
            name: getattr(model, name).detach().clone().requires_grad_(True) for name in rates
        }
        self.model = replace(model, **parameters, thresholds=None)
        self.rates = rates
        self.optimizer = torch.optim.Adam(
            [{"params": [parameters[name]], "lr": rate} for name, rate in rates.items()], eps=1e-15
        )
        if settings.truncate:
            store.open(torch.sigmoid(model.opacity))

    def result_model(self) -> SplatFile:
        """The model as learned, free of gradients."""
        return replace(
            self.model, **{name: getattr(self.model, name).detach() for name in self.rates}
        )

    def learn(self, progress: bool) -> None:
        """All steps."""
        from tqdm import tqdm

        total = self.settings.iterations
        every = max(1, total // RECORDS)
        with tqdm(total=total, disable=not progress, desc="fine-tuning", unit="it") as bar:
            for shot in self._order():
                if self.calibration is not None and self.step >= self.calibration:
                    self.calibration = None
                    self._meet_target()
                self._learn_from(shot)
                bar.update()
                if self.step % every == 0 or self.step == total:
                    record = self._record()
                    bar.set_postfix(
                        loss=f"{record.loss:.4f}", fragments=f"{record.fragments_per_pixel:.1f}/px"
                    )
        if self.settings.target_speedup is not None:
            self._meet_target()

    def _order(self) -> Iterator[Shot]:
        """Permutations of the training views, one after the other, for all steps."""
        stream = random.Random(self.settings.seed)
        queue: list[Shot] = []
        for _ in range(self.settings.iterations):
            if not queue:
                queue = list(self.dataset.train)
                stream.shuffle(queue)
            yield queue.pop()

    def _learn_from(self, shot: Shot) -> None:
        plan = self.schedule.at(self.step + 1)
        truncate = self.settings.truncate
        learn = truncate and plan.learn and not self.held
        thresholds = self.store.values if learn else self.store.values.detach()
        outputs = self.engine.rasterize(
            RasterInputs(shot.view, self.model.splats()), thresholds if truncate else None
        )
        loss = photometric_loss(outputs.image, shot.image)
        drawn = float(outputs.fragments_per_pixel.detach())
        objective = loss
        if learn and self.pressure.value > 0:
            objective = loss + self.pressure.value * outputs.fragments_per_pixel
        torch.autograd.backward(objective)

        opacity_lr = self.settings.opacity_lr if plan.opacity_lr is None else plan.opacity_lr
        decay = opacity_lr / self.settings.opacity_lr
        for group, rate in zip(self.optimizer.param_groups, self.rates.values(), strict=True):
            group["lr"] = rate * decay
        self.optimizer.step()
        self.optimizer.zero_grad(set_to_none=True)
        if learn:
            self.store.step(plan.threshold_lr)
            self.pressure.observe(
                Observation(plan.progress, drawn, self._baseline(shot), float(loss.detach()))
            )
        self.step += 1
        self._recent.append((float(loss.detach()), drawn))

    def _baseline(self, shot: Shot) -> float:
        """Fragments per pixel of the untruncated model as it came in, measured once a view."""
        if shot.name not in self._untruncated:
            self._untruncated[shot.name] = mean_fragments(self.initial, None, [shot], self.engine)
        return self._untruncated[shot.name]

    def _meet_target(self) -> None:
        """Shift all thresholds so that training views meet the target; from then on hold them."""
        target = self.settings.target_speedup
        assert target is not None
        train = self.dataset.train
        shots = train[:: -(-len(train) // CALIBRATION_VIEWS)]
        before = sum(self._baseline(shot) for shot in shots) / len(shots)
        model = self.result_model()

        def speedup() -> float:
            values = self.store.values.detach()
            return before / max(mean_fragments(model, values, shots, self.engine), 1e-9)

        calibrate(self.store, speedup, target)
        self.held = True

    def _record(self) -> Record:
        losses, fragments = zip(*self._recent, strict=True)
        points = torch.tensor(QUANTILES)
        values = self.store.values.detach()
        step = max(1, len(values) // 100_000)  # torch.quantile refuses very long inputs
        record = Record(
            step=self.step,
            loss=sum(losses) / len(losses),
            fragments_per_pixel=sum(fragments) / len(fragments),
            pressure=self.pressure.value,
            thresholds=tuple(torch.quantile(values[::step], points).tolist()),
        )
        self.records.append(record)
        return record
