"""Where stage 2 starts: the checkpoint or PLY that it goes on from."""

from __future__ import annotations

import contextlib
import logging
from collections.abc import Iterator
from pathlib import Path
from pickle import UnpicklingError
from typing import Any, NamedTuple

from fragprune_plugins.errors import ModelFileError, UsageError
from fragprune_plugins.hosts.adapter import CHECKPOINT_KEY, CommandLine, ScriptAdapter
from fragprune_plugins.injection.command import HostCommand
from fragprune_plugins.injection.process import host_checkpoints
from fragprune_plugins.storage import records

log = logging.getLogger("fragprune")


class Start(NamedTuple):
    """A starting point.

    Attributes:
        iteration: of the host, that the file was written at.
        path: the file.
        why: this one.
    """

    iteration: int
    path: Path
    why: str


def find(adapter: ScriptAdapter, host: HostCommand, output: Path | None) -> Start:
    """What the command names; else the newest file of its folder that training alone wrote.

    Raises:
        UsageError: there is none.
        ModelFileError: a checkpoint cannot be read.
    """
    if host.flags.resume:
        path = Path(host.flags.resume)
        ply = path.suffix == ".ply" and not host.line.restarts
        at = _iteration_of_ply(path) if ply else resumed_at(host.line, path)
        return Start(at, path, "the command names it")
    where, flag = output or "no output folder", host.line.spellings("resume")[-1]
    saved, newer = files(adapter, output), 0
    while saved and _learned(adapter, saved[-1][1]):
        saved.pop()
        newer += 1
    if not saved and newer:
        raise UsageError(
            "--stage finetune",
            f"nothing in {where} but what was learned here, or a control",
            "what training alone wrote",
            f"To go on from one of these files, name it with {flag}.",
        )
    if not saved:
        raise UsageError(
            "--stage finetune",
            f"nothing to start from in {where}",
            f"{flag} FILE, or {host.line.output[-1]} DIR of a finished training",
            "Name one of them in the host's command.",
        )
    iteration, path = saved[-1]
    later = [(at, file) for at, file in saved if at > iteration and not _learned(adapter, file)]
    if later:
        log.warning(
            "%s is of a later iteration, but older than what stage 2 starts from; "
            "if you meant it, name it with %s",
            max(reversed(later), key=lambda each: each[0])[1],
            flag,
        )
    passed = f"; {newer} newer of stage 2 passed over" if newer else ""
    return Start(iteration, path, f"what training alone wrote last{passed}")


def files(adapter: ScriptAdapter, output: Path | None) -> list[tuple[int, Path]]:
    """Iterations that a folder holds, and their files, the newest last."""
    return adapter.saved_iterations(output) if output else []


def resumed_at(line: CommandLine, checkpoint: Path) -> int:
    """The iteration that a run from a checkpoint goes on after.

    Raises:
        UsageError: there is none.
        ModelFileError: it cannot be read.
    """
    return 0 if line.restarts else _read_checkpoint(checkpoint)[1]


@contextlib.contextmanager
def resumable(adapter: ScriptAdapter, line: CommandLine, start: Start) -> Iterator[Path]:
    """A file that the host itself can resume; a checkpoint made of a PLY is removed afterwards."""
    if start.path.suffix != ".ply" or line.restarts:
        yield start.path
        return
    made = start.path.with_name(f".fragprune_{start.iteration}.pth")
    adapter.checkpoint_from_ply(start.path, start.iteration, made)
    try:
        yield made
    finally:
        made.unlink(missing_ok=True)


def _learned(adapter: ScriptAdapter, path: Path) -> bool:
    """Whether a file was written while thresholds learned, or by a control: not by stage 1."""
    from fragprune_plugins.storage import sidecar

    record = records.beside(path)  # version 0.1 marked its controls by nothing else
    if record is not None and record.command == "run":
        return True
    if path.suffix == ".ply":
        return sidecar.belongs(path)
    return CHECKPOINT_KEY in adapter.checkpoint_state(_read_checkpoint(path)[0])


def _iteration_of_ply(ply: Path) -> int:
    """By its folder, as hosts save: ``iteration_N/point_cloud.ply``."""
    number = ply.parent.name.removeprefix("iteration_")
    if ply.is_file() and number.isdigit():
        return int(number)
    raise UsageError(
        str(ply),
        "a PLY outside iteration_N" if ply.is_file() else "no such file",
        "a checkpoint, or point_cloud/iteration_N/point_cloud.ply",
        "Check the path.",
    )


def _read_checkpoint(path: Path) -> tuple[Any, int]:
    """What a checkpoint holds, its tensors still on disk: hosts save (capture, iteration).

    Raises:
        UsageError: there is none.
        ModelFileError: it cannot be read.
    """
    import torch

    if not path.is_file():
        raise UsageError(str(path), "no such file", "a checkpoint", "Check the path.")
    try:
        with host_checkpoints():
            capture, iteration = torch.load(path, map_location="cpu", weights_only=True, mmap=True)
            return capture, int(iteration)
    except (UnpicklingError, RuntimeError, OSError, EOFError, ValueError, TypeError) as error:
        raise ModelFileError(
            str(path),
            f"not readable as a checkpoint ({str(error).splitlines()[0]})",
            "(capture, iteration), as hosts save it",
            "It was cut off, or is no checkpoint: remove it, or name another.",
        ) from error
