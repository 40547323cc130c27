"""An unfinished fine-tuning is kept in a file, from which the same fine-tuning goes on."""

from __future__ import annotations

import hashlib
import json
import os
import time
from collections.abc import Callable, Iterable
from dataclasses import dataclass, field
from functools import lru_cache
from pathlib import Path
from typing import Any

import torch
from safetensors import SafetensorError, safe_open
from safetensors.torch import save_file
from torch import Tensor

from fragprune_plugins.constants import VERSION
from fragprune_plugins.errors import CheckpointError, OutputError
from fragprune_plugins.files.atomic import digest, replacing
from fragprune_plugins.files.model import Model
from fragprune_plugins.files.reading import UntrustedFile, parse_json
from fragprune_plugins.learning.finite import expect_finite, not_finite
from fragprune_plugins.learning.plain import numbers_of
from fragprune_plugins.learning.schedule import Schedule, Settings
from fragprune_plugins.plugins import hookspecs
from fragprune_plugins.plugins.hooks import schedule_for
from fragprune_plugins.plugins.loading import installed
from fragprune_plugins.workbench.scenes.dataset import Dataset, Photograph, Shot
from fragprune_plugins.workbench.scenes.images import IMAGE_FILE

FORMAT = "fragprune-checkpoint-1"
SUFFIX = ".fragprune-unfinished"
EVERY = 300.0
"""Seconds between two checkpoints."""

_DECIDING = (hookspecs.fragprune_truncate, hookspecs.fragprune_create_schedule)
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

        Where that fails, the one before stays, and somebody is told. It stays, too, where a tensor
        holds NaN or infinity: DivergedError. Floats in ``values`` come back to the bit.
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

        One that cannot be read, or has another configuration than is asked for, is a
        CheckpointError.
        """
        if not self.path.exists():
            return {}, {}
        tensors, values = read(self.path, device)
        found = values.get("configuration", {})
        if differ := [key for key in sorted(found | asked) if found.get(key) != asked.get(key)]:
            other = [name for name in differ if name != "schedule"] or differ  # settings make it
            raise CheckpointError(
                str(self.path),
                f"an unfinished fine-tuning with other {', '.join(other)}",
                "the fine-tuning that was asked for",
                "Repeat the command that was interrupted to finish it, or begin anew with --again.",
            )
        return tensors, values

    def tell_of(self, done: int, total: int, threads: int) -> None:
        """Say from which step the fine-tuning goes on, and whether bits may differ."""
        self.tell(f"resuming at step {done} of {total}, from {self.path}")
        if threads != (now := torch.get_num_threads()):
            self.tell(
                f"it was begun on {threads} threads, and goes on on {now}: the last bits of the "
                "result may differ"
            )

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


def configuration(
    model: Model,
    dataset: Dataset,
    settings: Settings,
    engine: str,
    schedule: Schedule | None = None,
) -> dict[str, Any]:
    """What decides the result of a fine-tuning, as plain values; files are read for digests."""
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


def _of(shot: Shot) -> Iterable[Tensor | str]:
    yield f"{shot.name} {shot.view.width} {shot.view.height} {shot.target}"
    yield from (shot.view.viewmatrix, shot.view.projmatrix, shot.view.background)
    if isinstance(shot, Photograph):
        yield _content(shot.path)
        if shot.opaque and shot.transparent:
            yield "opaque"
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
