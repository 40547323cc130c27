"""Records: the figures of a command as JSON beside its result, for ``fragprune report``."""

from __future__ import annotations

import contextlib
import json
import math
import os
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

import click

from fragprune_plugins.errors import OutputError, RecordError, printable
from fragprune_plugins.files.atomic import digest, replacing
from fragprune_plugins.files.reading import MEBIBYTE, UntrustedFile, lies_in
from fragprune_plugins.hosts.photographs import Photographs, Resolution, Similarity

SUFFIX = ".fragprune.json"
FORMAT = "fragprune-record-1"
RECORD_FILE = UntrustedFile(
    RecordError, "unreadable", f"a file of format {FORMAT}", "Remove it.", limit=64 * MEBIBYTE
)
"""``RECORD_FILE.stated(record.path)`` is around whatever takes values out of a record."""

CONTROL = "control"  # the goal of a control, as settings in records have it
_OF_CONTROLS = ("train", "opacity_lr", "seed", "views_per_step")
_SAME_DB = 1e-3  # engines and machines differ by less in the PSNR of one model
_NUMBERS = {"scale_modifier", "dilation", "near", "alpha_max"}  # of ``RasterInputs``, as numbers


@dataclass(frozen=True)
class Record:
    """The figures of one command."""

    path: Path
    command: str  # that wrote it: run, finetune, compare or profile
    data: dict[str, Any]  # its --json output, and further data for the page
    sha256: str | None = None  # of the result, if it is a file


def leave(model: Path, command: str, data: dict[str, Any]) -> Path:
    """Write a record beside a result; paths become relative to its folder (``portable``)."""
    target = path_beside(model)
    content = {"format": FORMAT, "command": command, "data": portable(data, target.parent)}
    if model.is_file():
        content["sha256"] = digest(model)
    with replacing(target, durable=True) as temporary:
        temporary.write_text(json.dumps(strict(content), indent=1) + "\n", encoding="utf-8")
    return target


def leave_or_tell(model: Path, command: str, data: dict[str, Any]) -> int:
    """Leave a record; returns the exit code, 1 without one: its figures are still to be told."""
    try:
        leave(model, command, data)
    except OutputError as error:
        click.echo(printable(f"{model} is written, its record is not: {error}"), err=True)
        return 1
    return 0


def path_beside(result: Path) -> Path:
    """The path of a result's record."""
    return Path(result).with_suffix(SUFFIX)


def beside(result: Path) -> Record | None:
    """Read the record of a result; None if there is none or the result was rewritten since.

    A copy may be newer than its record: there the content tells. RecordError if it is broken.
    """
    path = path_beside(result)
    if not os.path.exists(path):
        return None
    record, current = _read(path), path.stat().st_mtime_ns >= result.stat().st_mtime_ns
    return record if current or (record.sha256 and record.sha256 == digest(result)) else None


def find(folder: Path) -> list[Record]:
    """Read all records in a folder and below, oldest first; RecordError if there is none."""
    found = files(folder, below=True)
    if not found:
        what, remedy = f"no file *{SUFFIX} in it or below", "Run one of these first."
        if folder.is_file():
            page, look = f"fragprune report {folder.parent}", f"fragprune view {folder}"
            what, remedy = "a file", f"For the page: {page}; to look at a model: {look}"
        elif not folder.exists():
            what, remedy = "no such folder", f"Check the name. {remedy}"
        expected = "a folder that run or finetune wrote, or compare or profile with --out"
        raise RecordError(str(folder), what, expected, remedy)
    return [_read(path) for path in found]


def files(folder: Path, *, below: bool = False) -> list[Path]:
    """The files of records in a folder, optionally also below it, oldest first."""
    every = Path(folder).glob(f"{'**/' if below else ''}*{SUFFIX}")
    inside = [path for path in every if lies_in(path, folder) and os.path.exists(path)]
    return sorted(inside, key=lambda path: path.stat().st_mtime)


def portable(value: Any, folder: Path) -> Any:
    """A value whose texts name no folder of this machine, as far as paths can be recognised.

    Absolute paths become relative to ``folder``, or to ``~`` if only the path is in the home
    folder; ``located`` finds them again. Other texts lose ``folder``, and say ``~`` for the home.
    """
    homes, (near, base) = _spellings(Path.home()), _spellings(folder)
    short = ((near, ""), (base, ""), *((home, "~" + os.sep) for home in homes))

    def shortened(value: Any) -> Any:
        if not isinstance(value, str):
            return value
        if os.path.isabs(value):
            path = Path(os.path.normpath(value))
            for home in homes:
                if path.is_relative_to(home) and not Path(base).is_relative_to(home):
                    return str("~" / path.relative_to(home))
            value = os.path.relpath(path, base)
        for known, instead in short:
            value = value.replace(known + os.sep, instead)
        return value

    return _each(value, shortened)


def _each(value: Any, change: Callable[[Any], Any]) -> Any:
    """A plain value with every value in its dicts and lists changed."""
    if isinstance(value, dict):
        return {key: _each(item, change) for key, item in value.items()}
    if isinstance(value, list | tuple):
        return [_each(item, change) for item in value]
    return change(value)


def located(text: str, folder: Path) -> Path:
    """The path that ``portable`` made a text of, from the folder of the record that has it."""
    return Path(os.path.normpath(Path(os.path.realpath(folder)) / Path(text).expanduser()))


def _spellings(path: str | Path) -> list[str]:
    """A folder's absolute path, as it is named and with its links followed."""
    return [os.path.abspath(path), os.path.realpath(path)]


@dataclass(frozen=True)
class Recorded:
    """The "photographs" of a record."""

    photographs: Photographs
    models: tuple[Path, ...]
    """The model before and the model after; joint learning leaves the latter alone."""
    filtered: bool = False  # whether only their host's rules may draw them; see ``read_ply``
    drawing: Mapping[str, Any] = field(default_factory=dict)
    """Fields of ``RasterInputs`` that differ from vanilla's rules."""

    def as_dict(self) -> dict[str, Any]:
        """Plain values, for ``recorded``."""
        return plain(self.photographs) | {
            "models": [str(model.resolve()) for model in self.models],
            "filtered": self.filtered,
            "drawing": dict(self.drawing),
        }


def plain(photographs: Photographs) -> dict[str, Any]:
    """Plain values, for records."""
    return asdict(photographs) | {"folder": str(photographs.folder.resolve())}


def recorded(record: Record) -> Recorded | None:
    """The photographs and models of a record; None if it names none. RecordError of other types."""
    with RECORD_FILE.stated(record.path) as reading:
        values = record.data.get("photographs")
        if values is None:
            return None
        reading.place = "data.photographs"
        folder = record.path.parent
        models = tuple(located(each, folder) for each in values["models"])
        if not 1 <= len(models) <= 2:
            raise ValueError(f"{len(models)} models")
        drawing = dict(values["drawing"])
        for name, value in drawing.items():
            number = isinstance(value, int | float) and 0 <= value < 1e6
            if not (number if name in _NUMBERS else name == "compensation"):
                raise ValueError(f"{name} is {value!r}")
        photographs = Photographs(
            located(values["folder"], folder),
            Resolution(**values["resolution"]),
            values["white_background"],
            values["images"],
            centred=None if values.get("centred") is None else bool(values["centred"]),
            opaque=bool(values.get("opaque")),
            world=_similarity(values.get("world")),
        )
        return Recorded(photographs, models, bool(values["filtered"]), drawing)


def _similarity(rows: Any) -> Similarity | None:
    """``Photographs.world`` of a record; cameras check that it turns and scales alone."""
    if rows is None:
        return None
    world = tuple(tuple(map(float, row)) for row in rows)
    if [len(row) for row in world] != [4] * 4 or world[3] != (0, 0, 0, 1):
        raise ValueError(f"world is {rows!r}")
    return world


def control_of(data: dict[str, Any], among: Sequence[Path]) -> dict[str, Any] | None:
    """Find the measurement of a fine-tuning's control; None if no file records it. The last counts.

    It started from the same model, by the same loop and options, on the same photographs as far as
    is known, with the same iterations, views in each step, seed and settings, and kept as many
    Gaussians or all, but without truncation and without a stop or a dropout of its own.
    """
    for path in reversed(among):
        with contextlib.suppress(RecordError), RECORD_FILE.stated(path):
            other = _read(path).data
            if _is_control(other, data):
                after: dict[str, Any] = other["after"]
                return after
    return None


def _is_control(other: dict[str, Any], data: dict[str, Any]) -> bool:
    mine, theirs = data.get("settings", {}), other.get("settings", {})
    begun, before = other.get("before"), data.get("before")
    return bool(
        mine.get("goal", CONTROL) != CONTROL
        and theirs.get("goal") == CONTROL
        and all(mine[key] == theirs.get(key) for key in _OF_CONTROLS)
        and theirs.get("stop") in (None, "auto")
        and theirs.get("dropout") in (None, 0, mine.get("dropout"))
        and other.get("adapter") == data.get("adapter")
        and other.get("host_options") in (None, data.get("host_options"))
        and other["iterations"] == data["iterations"]
        and other.get("pictures") in (None, data.get("pictures"))
        and other.get("keep") in (None, data.get("keep"))
        and begun
        and before
        and all(begun[key] == before[key] for key in ("views", "gaussians"))
        and None not in (begun["psnr"], before["psnr"])
        and abs(begun["psnr"] - before["psnr"]) < _SAME_DB
    )


def _read(path: Path) -> Record:
    with RECORD_FILE.reading(path) as reading:
        content = reading.json()
        if not isinstance(content, dict) or content.get("format") != FORMAT:
            raise ValueError("another format")
        command, data = content["command"], content["data"]
        if not isinstance(command, str) or not isinstance(data, dict):
            raise ValueError("command and data of other types")
        return Record(path, command, data, content.get("sha256"))


def strict(value: Any) -> Any:
    """Replace NaN and infinity by null, because JSON has neither."""
    return _each(value, lambda v: None if isinstance(v, float) and not math.isfinite(v) else v)
