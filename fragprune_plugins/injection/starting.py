"""Finds the checkpoint or PLY from which stage 2 starts."""

from __future__ import annotations

import contextlib
import hashlib
from collections.abc import Iterable, Iterator
from pathlib import Path
from typing import Any, NamedTuple

import torch
from plyfile import PlyData
from torch import Tensor

from fragprune_plugins.errors import ModelFileError, UsageError, log
from fragprune_plugins.files import sidecar
from fragprune_plugins.files.atomic import replacing
from fragprune_plugins.files.ply import read_thresholds
from fragprune_plugins.files.reading import UntrustedFile
from fragprune_plugins.hosts.adapter import (
    CHECKPOINT_KEY,
    CommandLine,
    ScriptAdapter,
    optimizer_state,
)
from fragprune_plugins.injection.command import HostCommand
from fragprune_plugins.injection.process import knowing_numpy
from fragprune_plugins.injection.saving import changed, tensors_of

_FILE = UntrustedFile(
    ModelFileError,
    "not readable as a checkpoint",
    "(capture, iteration), as hosts save it",
    "The file is cut off, or is no checkpoint. Remove it, or name another file.",
)

_SAFELY: dict[str, Any] = {"weights_only": True, "mmap": True}
if not hasattr(torch.serialization, "safe_globals"):  # torch before 2.5
    _SAFELY = {"weights_only": False}

FINISHED = "stage1.fragprune-finished"  # in the host's folder, until stage 2 is, too


class Start(NamedTuple):
    """The file from which stage 2 starts."""

    iteration: int  # the host's, that wrote the file
    path: Path
    why: str  # the reason for this file, for a log line


def find(adapter: ScriptAdapter, host: HostCommand, output: Path | None) -> Start:
    """The file that the command names, else the newest file of stage 1 in its output folder."""
    if host.flags.resume:
        path = Path(host.flags.resume)
        ply = path.suffix == ".ply" and not host.line.restarts
        at = _iteration_of_ply(path) if ply else resumed_at(host.line, path)
        return Start(at, path, "the command names it")
    where, flag = output or "no output folder", host.line.spellings("resume")[-1]
    saved, newer = files(adapter, output), 0
    while saved and (known := _learned(saved[-1][1])) is not None:
        saved.pop()
        newer += 1
        if known.get("midway"):  # other files are from within that training, or older
            saved = []
    if not saved:
        found, expected = "no model", f"{flag} FILE, or {host.line.output[-1]} DIR of a training"
        remedy = "Add one of these flags to the host's command."
        if newer:
            found = "only results of stage 2 or of a control, or a joint training's and older files"
            expected = "one of a training"
            remedy = f"To continue from one of these files, name it with {flag}."
        raise UsageError("--stage finetune", f"{found} in {where}", expected, remedy)
    iteration, path = saved[-1]
    later = [(at, file) for at, file in saved if at > iteration and _learned(file) is None]
    if later:
        log.warning(
            "%s is of a later iteration, but it is older than the file from which stage 2 starts; "
            "to start from it, name it with %s",
            *(max(reversed(later), key=lambda each: each[0])[1], flag),
        )
    passed = f"; newer files of stage 2 ignored: {newer}" if newer else ""
    return Start(iteration, path, f"the last file that the host's own training wrote{passed}")


def trains_on(host: HostCommand) -> bool:
    """Whether the file that a command names is of a training that it has yet to end."""
    line, path = host.line, Path(host.flags.resume)
    if path.suffix == ".ply" or line.restarts or host.script.name in line.continues:
        return host.script.name in line.continues
    return resumed_at(line, path) < host.iterations and _learned(path) is None


def ended(adapter: ScriptAdapter, host: HostCommand) -> Start | None:
    """The end of a training that begins with a file of another; None if there is none yet."""
    begins = host.script.name in host.line.continues or (host.flags.resume and trains_on(host))
    ends = [path for at, path in files(adapter, host.output) if begins and at == host.iterations]
    return Start(host.iterations, ends[-1], "the end of its training") if ends else None


def files(adapter: ScriptAdapter, output: Path | None) -> list[tuple[int, Path]]:
    """(iteration, file) of every model in an output folder, the newest last."""
    return adapter.saved_iterations(output) if output else []


def whole(path: Path) -> bool:
    """Whether a model of stage 1 can be read to its end: a full disk cuts files off."""
    with contextlib.suppress(ModelFileError), _FILE.reading(path):
        return bool(PlyData.read(path) if path.suffix == ".ply" else _read_checkpoint(path))
    return False


def remember(start: Start, host: HostCommand, commit: str) -> None:
    """Mark stage 1 as finished in its output folder, if it has one; see ``finished``."""
    if host.output is not None and host.output.is_dir():
        with replacing(host.output / FINISHED) as mark:
            mark.write_text(_identity(start.path, host, commit))


def finished(adapter: ScriptAdapter, host: HostCommand, commit: str) -> Start | None:
    """The end of stage 1, if an earlier run of this very command finished it and not stage 2."""
    if host.output is None or not (mark := host.output / FINISHED).is_file():
        return None
    known = mark.read_text(errors="replace")
    for iteration, path in files(adapter, host.output):
        if iteration == host.iterations and _identity(path, host, commit) == known:
            log.info("stage 1 was finished by the same command; --again repeats it")
            return Start(iteration, path, "the end of stage 1")
    return None


def forget(host: HostCommand) -> None:
    """Remove the mark: stage 2 is finished too, and the same command trains anew."""
    if host.output is not None:
        (host.output / FINISHED).unlink(missing_ok=True)


def _identity(path: Path, host: HostCommand, commit: str) -> str:
    """A digest of a file's name, time and size, and of the command and host that wrote it."""
    state = path.stat()
    parts = (path.name, state.st_mtime_ns, state.st_size, commit, host.script, *host.arguments)
    return hashlib.sha256("\0".join(map(str, parts)).encode(errors="surrogatepass")).hexdigest()


def resumed_at(line: CommandLine, checkpoint: Path) -> int:
    """The iteration after which a run from this checkpoint continues."""
    return 0 if line.restarts else _read_checkpoint(checkpoint)[1]


@contextlib.contextmanager
def resumable(adapter: ScriptAdapter, line: CommandLine, start: Start) -> Iterator[Path]:
    """Yields a file that the host can resume; a checkpoint made from a PLY exists only inside."""
    makes = start.path.suffix == ".ply" and not line.restarts
    path = start.path.with_name(line.made.format(start.iteration)) if makes else start.path
    adapter.expect_resumable(path)
    if makes:
        adapter.checkpoint_from_ply(start.path, start.iteration, path)
    try:
        yield path
    finally:
        if makes:
            path.unlink(missing_ok=True)


def holds(start: Path, ply: Path) -> bool:
    """Whether a file that the host can resume holds the Gaussians of a PLY of the same iteration.

    Hosts write a PLY before they densify or relocate in its iteration, a checkpoint after that.
    """
    return start.suffix == ".ply" or same_means(ply, tensors_of(_read_checkpoint(start)[0]))


def same_means(ply: Path, among: Iterable[Tensor], share: float = 1.0) -> bool:
    """Whether one of some tensors has the means of a PLY, or a share of them, but for a step."""
    rows = PlyData.read(ply)["vertex"].data
    xyz = torch.stack([torch.from_numpy(rows[each].copy()) for each in "xyz"], dim=1)
    far = 0.01 * (xyz - xyz.median(dim=0).values).abs().median()  # no step moves one as far
    same = (each for each in among if each.shape == xyz.shape)
    near = (((each - xyz).abs() <= far).all(dim=1).float().mean() for each in same)
    return any(float(each) >= share for each in near)


def part_of(start: Path, kept: Tensor | None, folder: Path) -> Path:
    """A copy of a file to resume, of the same name, with the Gaussians of ``kept``, (N,) bool.

    Whatever has a row for each Gaussian keeps a part: parameters, moments, statistics.
    """
    if kept is None:
        return start
    target = folder / start.name
    if start.suffix == ".ply":
        ply = PlyData.read(start)
        ply["vertex"].data = ply["vertex"].data[kept.numpy()]
        ply.write(target)
    else:
        capture, iteration = _read_checkpoint(start)
        part = changed(capture, lambda own: own[kept] if own.shape[:1] == kept.shape else own)
        torch.save((part, iteration), target)
    return target


def _learned(path: Path) -> dict[str, Any] | None:
    """What a file tells of how it learned; None if stage 1 wrote it, not stage 2 or a control."""
    if path.suffix != ".ply":
        return optimizer_state(_read_checkpoint(path)[0], str(path)).get(CHECKPOINT_KEY)
    if sidecar.belongs(path):
        return sidecar.load(path)[1].settings
    return None if read_thresholds(path) is None else {}


def _iteration_of_ply(ply: Path) -> int:
    """The iteration in the name of a PLY's folder, ``iteration_N/point_cloud.ply``."""
    number = ply.parent.name.removeprefix("iteration_")
    if ply.is_file() and number.isdigit():
        return int(number)
    found = "a PLY outside iteration_N" if ply.is_file() else "no such file"
    expected = "a checkpoint, or point_cloud/iteration_N/point_cloud.ply"
    raise UsageError(str(ply), found, expected, "Check the path.")


def _read_checkpoint(path: Path) -> tuple[Any, int]:
    """Read (capture, iteration) of a checkpoint; tensors are mapped from the file."""
    if not path.exists():
        raise UsageError(str(path), "no such file", "a checkpoint", "Check the path.")
    with _FILE.reading(path), knowing_numpy():
        # Safely, nothing in it is run; an old torch loads it as the hosts do.
        capture, iteration = torch.load(path, "cpu", **_SAFELY)
        return capture, int(iteration)
