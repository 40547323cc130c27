"""An unfinished fine-tuning is kept in a file, from which the same fine-tuning goes on."""

from __future__ import annotations

import hashlib
import json
import os
import time
from collections.abc import Callable, Iterable
from dataclasses import astuple, dataclass, field
from functools import lru_cache
from pathlib import Path
from typing import Any

import torch
from safetensors import SafetensorError, safe_open
from safetensors.torch import save_file
from torch import Tensor

from fragprune_plugins.constants import VERSION
from fragprune_plugins.errors import CheckpointError, OutputError, SidecarError
from fragprune_plugins.files.atomic import digest, replacing
from fragprune_plugins.files.model import Model
from fragprune_plugins.files.reading import UntrustedFile, parse_json
from fragprune_plugins.learning.events import StepStats
from fragprune_plugins.learning.finite import expect_finite, not_finite
from fragprune_plugins.learning.plain import numbers_of
from fragprune_plugins.learning.schedule import Schedule, Settings
from fragprune_plugins.plugins import hookspecs
from fragprune_plugins.plugins.hooks import schedule_for
from fragprune_plugins.plugins.loading import installed
from fragprune_plugins.workbench.finetune.loop import Training
from fragprune_plugins.workbench.finetune.losses import code_for
from fragprune_plugins.workbench.scenes.dataset import Dataset, Photograph, Shot
from fragprune_plugins.workbench.scenes.images import IMAGE_FILE

FORMAT = "fragprune-checkpoint-1"
SUFFIX = ".fragprune-unfinished"
EVERY = 300.0
"""Seconds between two checkpoints."""

_DECIDING = (hookspecs.fragprune_truncate, hookspecs.fragprune_create_schedule)
_MOMENTS = ("exp_avg", "exp_avg_sq")
_OF_VIEWS = {"before", "after"}  # of stage 2's tensors; all others have a row for each Gaussian
_UNFIT = (  # raised where the parts of a checkpoint do not fit what they are loaded into
    *(KeyError, ValueError, TypeError, IndexError, RuntimeError, AttributeError, OverflowError),
    SidecarError,
)
_FILE = UntrustedFile(
    CheckpointError,
    "unreadable",
    f"a file of format {FORMAT}",
    "Remove it, or begin anew with --again.",
)


def path_beside(out: Path) -> Path:
    """Where the checkpoint of a fine-tuning lies whose result goes into a model file."""
    return Path(out).with_suffix(SUFFIX)


@dataclass
class Checkpoints:
    """Keeps an unfinished fine-tuning in a file.

    Attributes:
        path: the file; see ``path_beside``.
        seconds: between two checkpoints; None for none but at Ctrl-C and SIGTERM.
        steps: write one after every so many steps as well.
        tell: is told in a sentence from which step the fine-tuning goes on.
    """

    path: Path
    seconds: float | None = EVERY
    steps: int | None = None
    tell: Callable[[str], None] = lambda _: None
    _last: float = field(default_factory=time.monotonic)

    def __post_init__(self) -> None:
        self.path = Path(self.path)

    def due(self, step: int) -> bool:
        """Whether it is time for a checkpoint after a step."""
        if self.steps is not None and step % self.steps == 0:
            return True
        return self.seconds is not None and time.monotonic() - self._last >= self.seconds

    def save(self, tensors: dict[str, Tensor], values: dict[str, Any]) -> None:
        """Write a checkpoint durably in the place of the one before.

        Where that fails, the one before stays, and somebody is told.

        Args:
            values: whatever JSON can hold; floats come back to the bit.

        Raises:
            DivergedError: a tensor holds NaN or infinity. The one before stays.
        """
        expect_finite({k: each for k, each in tensors.items() if k != "curves"}, str(self.path))
        content = {name: tensor.detach().cpu().contiguous() for name, tensor in tensors.items()}
        metadata = {"format": FORMAT, "values": json.dumps(values)}
        try:
            with replacing(self.path, durable=True) as new:
                try:
                    save_file(content, new, metadata=metadata)
                except SafetensorError as error:  # that is how it says that the disk is full
                    raise OSError(str(error)) from error
        except OutputError as error:  # the fine-tuning is worth more than its checkpoint
            self.tell(f"no checkpoint was written. {error}")
        self._last = time.monotonic()

    def load(self, asked: dict[str, Any], device: Any) -> tuple[dict[str, Tensor], dict[str, Any]]:
        """Read the checkpoint; ({}, {}) if there is none.

        Raises:
            CheckpointError: it cannot be read, or has another ``configuration`` than is asked for.
        """
        if not self.path.exists():
            return {}, {}
        tensors, values = read(self.path, device)
        found = values.get("configuration", {})
        if differ := differences(found, asked):
            other = [name for name in differ if name != "schedule"] or differ  # settings make it
            raise CheckpointError(
                str(self.path),
                f"an unfinished fine-tuning with other {', '.join(other)}",
                "the fine-tuning that was asked for",
                "Repeat the command that was interrupted to finish it, or begin anew with --again.",
            )
        return tensors, values

    def clear(self) -> None:
        """Remove the file: the result is saved."""
        self.path.unlink(missing_ok=True)


def read(path: Path, device: torch.device | str) -> tuple[dict[str, Tensor], dict[str, Any]]:
    """The tensors and values of a checkpoint; raises CheckpointError if it cannot be read."""
    with _FILE.reading(path) as reading, safe_open(reading.path, framework="pt") as file:
        metadata = file.metadata()
        if metadata["format"] != FORMAT:
            raise ValueError(f"format {metadata['format'][:80]!r}")
        # copies: views into the file may lie in memory where other bits are rounded
        tensors = {key: file.get_tensor(key).clone().to(device) for key in file.keys()}  # noqa: SIM118
        if wrong := not_finite({k: each for k, each in tensors.items() if k != "curves"}):
            raise ValueError(f"NaN or infinity in {', '.join(wrong)}")
        return tensors, dict(parse_json(metadata["values"]))


class Keeper:
    """Takes a training over from its checkpoint, and writes the next ones."""

    def __init__(self, checkpoints: Checkpoints | None, training: Training) -> None:
        processes = training.processes
        self.checkpoints = checkpoints if processes.first else None
        if checkpoints is None and not processes.ranks.several:
            return
        given = training.start, training.dataset, training.settings, training.engine.name
        asked = configuration(*given, training.stage.schedule)
        self.asked = processes.described(asked) | {"loss": code_for(training.start.device)}
        if checkpoints is not None:
            self._go_on(checkpoints, training)
        known = {**self.asked, "checkpoint": training.done, "torch": torch.__version__}
        processes.ranks.agree(known, "fine-tuning, before its first step")

    def _go_on(self, checkpoints: Checkpoints, training: Training) -> None:
        """Take over what a checkpoint holds, if there is one."""
        device = "cpu" if training.processes.divided else training.start.device
        tensors, values = checkpoints.load(self.asked, device)
        if not values:
            return
        try:
            _unpack(training, tensors, values)
        except _UNFIT as error:
            raise CheckpointError(
                str(checkpoints.path),
                f"parts that do not fit together ({error})",
                "what a fine-tuning wrote",
                "Begin anew with --again.",
            ) from error
        checkpoints.tell(
            f"resuming at step {training.done} of {training.settings.iterations}, "
            f"from {checkpoints.path}"
        )
        if values["threads"] != torch.get_num_threads():
            checkpoints.tell(
                f"it was begun on {values['threads']} threads, and goes on on "
                f"{torch.get_num_threads()}: the last bits of the result may differ"
            )

    def due(self, step: int) -> bool:
        """Whether it is time for a checkpoint after a step, by this process."""
        return self.checkpoints is not None and self.checkpoints.due(step)

    def keep(self, training: Training) -> None:
        """Write a checkpoint, between two steps."""
        mine = self.checkpoints is not None or training.processes.divided
        if not mine or not training.optimizer.state:  # no step was taken
            return
        training.stage.check()
        tensors, values = _packed(training)
        if self.checkpoints is not None:  # the first process writes
            self.checkpoints.save(tensors, values | {"configuration": self.asked})


def _packed(training: Training) -> tuple[dict[str, Tensor], dict[str, Any]]:
    """Tensors and plain values from which ``_unpack`` goes on; all of the model's, in the first."""
    tensors, values = training.stage.state_dict()
    for name, parameter in training.parameters().items():
        tensors[f"model.{name}"] = parameter
        moments = training.optimizer.state[parameter]
        for moment in _MOMENTS:
            tensors[f"{moment}.{name}"] = moments[moment]
    for name in sorted(tensors.keys() - _OF_VIEWS):  # in the same order in all processes
        tensors[name] = training.processes.whole(tensors[name])
    points = [astuple(point) for point in training.curves]
    tensors["curves"] = torch.tensor(points, dtype=torch.float64).reshape(len(points), -1)
    return tensors, values | {
        "done": training.done,
        "adam_step": float(moments["step"]),
        "seconds": training.seconds,
        "threads": torch.get_num_threads(),
    }


def _unpack(training: Training, tensors: dict[str, Tensor], values: dict[str, Any]) -> None:
    """Take over what ``_packed`` gave; raises one of ``_UNFIT`` if it does not fit."""
    stage = training.stage
    for name in tensors.keys() - _OF_VIEWS - {"curves"}:
        tensors[name] = training.processes.own(tensors[name])
    stage.load_state_dict(tensors, values)
    if len(stage.store) != len(training.model):
        raise ValueError(f"{len(stage.store)} thresholds of {len(training.model)} Gaussians")
    for name, parameter in training.parameters().items():
        parameter.data.copy_(tensors[f"model.{name}"])
        step = torch.tensor(float(values["adam_step"]), dtype=torch.float32)
        state: dict[str, Tensor] = {"step": step}
        for moment in _MOMENTS:
            state[moment] = torch.empty_like(parameter).copy_(tensors[f"{moment}.{name}"])
        training.optimizer.state[parameter] = state
    for row in tensors["curves"].tolist():
        training.curves.append(StepStats(int(row[0]), *row[1:]))
    training.done = int(values["done"])
    if not 0 <= training.done == stage.steps <= training.settings.iterations:
        raise ValueError(f"{training.done} steps, of which the thresholds took {stage.steps}")
    training.started -= values["seconds"]


def configuration(
    model: Model,
    dataset: Dataset,
    settings: Settings,
    engine: str,
    schedule: Schedule | None = None,
) -> dict[str, Any]:
    """What decides the result of a fine-tuning, as plain values.

    Args:
        model: as it comes in, with its thresholds.
        dataset: its files are read whole, for their digest.
    """
    shots = (*dataset.train, *dataset.test)
    store = model.thresholds
    known: list[Tensor | str] = [] if store is None or store.neutral else [*store.numbers.values()]
    if model.stop is not None:
        known.append(f"stop {model.stop}")
    if model.rim != "hard":
        known.append(f"rim {model.rim}")
    return {
        "version": VERSION,
        "model": _digest(model.tensors.values()),
        "thresholds": _digest(known),
        "photographs": _digest(each for shot in shots for each in _of(shot)),
        "engine": engine,
        "plugins": sorted({name for hook in _DECIDING for name in installed().answering(hook)}),
        "schedule": described(schedule or schedule_for(settings)),
        "device": model.device.type,
        **settings.as_dict(),
    }


def described(schedule: Schedule) -> dict[str, Any]:
    """What decides beside the settings: a schedule's numbers and its pressure's."""
    pressure = schedule.make_pressure()
    return {
        "kind": type(schedule).__qualname__,
        **numbers_of(schedule),
        "pressure": {"kind": type(pressure).__qualname__, **numbers_of(pressure)},
    }


def differences(one: dict[str, Any], other: dict[str, Any]) -> list[str]:
    """Names under which two configurations differ."""
    return [key for key in sorted(one | other) if one.get(key) != other.get(key)]


def _of(shot: Shot) -> Iterable[Tensor | str]:
    yield f"{shot.name} {shot.view.width} {shot.view.height} {shot.target}"
    yield from (shot.view.viewmatrix, shot.view.projmatrix, shot.view.background)
    if isinstance(shot, Photograph):
        yield _content(shot.path)
        if shot.lens is not None:
            yield repr(shot.lens)
        if shot.mask is not None:
            yield _content(shot.mask)


def _content(image: Path) -> str:
    with IMAGE_FILE.reading(image) as reading:
        version = os.fstat(reading.file.fileno())
    return _photograph(image, version.st_mtime_ns, version.st_size)


@lru_cache(maxsize=10_000)  # a command asks for its configuration more than once
def _photograph(path: Path, changed: int, size: int) -> str:
    """The digest of a photograph, read once for as long as it does not change."""
    return digest(path)


def _digest(parts: Iterable[Tensor | str]) -> str:
    sha = hashlib.sha256()
    for part in parts:
        text = part if isinstance(part, str) else f"{part.dtype} {tuple(part.shape)}"
        sha.update(text.encode(errors="surrogatepass") + b"\0")
        if isinstance(part, Tensor):
            sha.update(part.detach().cpu().contiguous().numpy().tobytes())
    return sha.hexdigest()
