"""What commands leave beside their results for ``fragprune report``: their figures as JSON."""

from __future__ import annotations

import json
import math
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from fragprune_plugins.errors import RecordError
from fragprune_plugins.storage.atomic import replacing

SUFFIX = ".fragprune.json"
FORMAT = "fragprune-record-1"


@dataclass(frozen=True)
class Record:
    """One command's figures.

    Attributes:
        path: of the file.
        command: that left it: run, finetune, compare or profile.
        data: what it printed with --json, and what the page needs besides.
    """

    path: Path
    command: str
    data: dict[str, Any]


def leave(beside: Path, command: str, data: dict[str, Any]) -> Path:
    """Write a record beside a result, in place of the one an earlier command left there.

    Raises:
        OutputError: the place cannot be written.
    """
    target = Path(beside).with_suffix(SUFFIX)
    content = {"format": FORMAT, "command": command, "data": data}
    with replacing(target) as temporary:
        temporary.write_text(json.dumps(strict(content), indent=1) + "\n", encoding="utf-8")
    return target


def beside(result: Path) -> Record | None:
    """The record of a result, unless the result was written again since.

    Raises:
        RecordError: it cannot be read.
    """
    path = Path(result).with_suffix(SUFFIX)
    if not path.exists() or path.stat().st_mtime_ns < result.stat().st_mtime_ns:
        return None
    return _read(path)


def find(folder: Path) -> list[Record]:
    """All records in a folder and below, oldest first.

    Raises:
        RecordError: there is none, or one cannot be read.
    """
    files = sorted(Path(folder).rglob(f"*{SUFFIX}"), key=lambda path: path.stat().st_mtime)
    if not files:
        raise RecordError(
            str(folder),
            f"no file *{SUFFIX} in it or below",
            "a folder in which fragprune run, finetune, or compare and profile with --out, worked",
            "Run one of them, then report.",
        )
    return [_read(path) for path in files]


def _read(path: Path) -> Record:
    try:
        content = json.loads(path.read_text(encoding="utf-8"))
        if content["format"] != FORMAT:
            raise ValueError(f"format {content['format']!r}")
        return Record(path, content["command"], content["data"])
    except (OSError, ValueError, KeyError, TypeError) as error:
        raise RecordError(
            str(path), f"unreadable ({error})", f"a file of format {FORMAT}", "Remove it."
        ) from error


def strict(value: Any) -> Any:
    """JSON knows neither NaN nor infinity: null."""
    if isinstance(value, dict):
        return {key: strict(item) for key, item in value.items()}
    if isinstance(value, list | tuple):
        return [strict(item) for item in value]
    if isinstance(value, float) and not math.isfinite(value):
        return None
    return value
