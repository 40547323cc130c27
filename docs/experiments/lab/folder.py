"""The folder of an experiment: its configuration, what is done of it, and what comes out.

The configuration lies in NAME.json. A folder that was begun in another one is refused. Finished
parts lie in the folder ``arms``, so that an interrupted experiment goes on where it was.
"""

from __future__ import annotations

import csv
import hashlib
import io
import json
import re
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from fragprune_plugins.constants import VERSION
from fragprune_plugins.errors import RecordError
from fragprune_plugins.files.atomic import replacing
from fragprune_plugins.files.reading import MEBIBYTE, UntrustedFile
from fragprune_plugins.workbench.figures.records import strict
from fragprune_plugins.workbench.models.model import writable_folder

RESULTS = (".md", ".csv", ".png")
"""Endings of the files that results are written to, after the experiment's name."""

_FILE = UntrustedFile(
    RecordError, "unreadable", "a file that an experiment wrote", "Remove it.", limit=64 * MEBIBYTE
)

_ARMS = "arms"
_SAID = 5  # differences that a refusal lists


class Folder:
    """The folder of one experiment.

    Args:
        out: the folder; several experiments may share it.
        name: of the experiment, and of its files.
        asked: everything that decides about its figures, as plain values; our version is added.

    Attributes:
        asked: the configuration as it was written.

    Raises:
        RecordError: the folder holds this experiment in another configuration, or files of this
            name that no experiment wrote.
        OutputError: the folder cannot be written.
    """

    def __init__(self, out: Path, name: str, asked: dict[str, Any]) -> None:
        self.out, self.name = out, name
        self.asked: dict[str, Any] = json.loads(
            json.dumps({"experiment": name, "version": VERSION} | asked)
        )
        writable_folder(out / _ARMS)
        _settle(self.file(".json"), self.asked)
        self._mark = hashlib.sha256(json.dumps(self.asked, sort_keys=True).encode()).hexdigest()

    def part(self, index: int, label: str, make: Callable[[], dict[str, Any]]) -> dict[str, Any]:
        """One part of the experiment, as plain values: read if it is there, else made and kept.

        Args:
            index: of the part, first in its file's name.
            label: what it is; the file's name has it in a simple form.
            make: does the work.

        Raises:
            RecordError: the file cannot be read, or is one of another configuration.
        """
        slug = re.sub(r"[^a-z0-9.]+", "-", label.lower()).strip("-")
        path = self.out / _ARMS / f"{self.name}-{index:02d}-{slug}.json"
        if not path.exists():
            _write(path, {"configuration": self._mark, "part": label} | make())
        content = _load(path)
        if content.get("configuration") != self._mark:
            raise RecordError(
                str(path),
                "a result of another configuration",
                "one of the configuration that is asked for",
                "Choose another --out, or remove the file.",
            )
        return content

    def measured_with(self) -> str:
        """Lines of Markdown for the end of a page: version, engine, machine."""
        machine = self.asked["machine"]
        device = machine["gpu"] or machine["processor"]
        return (
            f"* fragprune {self.asked['version']}, {self.asked['engine']} engine on {device}, "
            f"{self.asked['threads']} threads\n* everything else: {self.name}.json"
        )

    def file(self, suffix: str) -> Path:
        """The path of NAME with this suffix, such as ".md"."""
        return self.out / f"{self.name}{suffix}"


@dataclass(frozen=True)
class Findings:
    """What an experiment found.

    Attributes:
        folder: of the experiment.
        asks: the question that is answered, one sentence.
        rows: the table, means over seeds; all have the keys of the first.
        table: what matters of it, in Markdown.
        text: below the table, in Markdown: how to read it and what was measured on what.
        plot: writes a PNG.
    """

    folder: Folder
    asks: str
    rows: Sequence[dict[str, Any]]
    table: str
    text: str
    plot: Callable[[Path], None]

    def publish(self) -> list[Path]:
        """Write NAME.md, NAME.csv and NAME.png; returns their paths and that of NAME.json.

        Raises:
            OutputError: a file cannot be written.
        """
        page, sheet, picture, _ = paths = [self.folder.file(end) for end in (*RESULTS, ".json")]
        name = self.folder.name
        with replacing(page) as temporary:
            parts = (f"# {name}", self.asks, self.table, self.text, f"![{self.asks}]({name}.png)")
            temporary.write_text("\n\n".join(parts) + "\n", encoding="utf-8")
        with replacing(sheet) as temporary:
            temporary.write_text(_csv(self.rows), encoding="utf-8")
        with replacing(picture) as temporary:
            self.plot(temporary)
        return paths


def markdown(head: Sequence[str], rows: Sequence[Sequence[str]]) -> str:
    """A table in Markdown; all columns but the first are aligned to the right."""
    lines = [head, ["---"] + ["---:"] * (len(head) - 1), *rows]
    return "\n".join(f"| {' | '.join(cells)} |" for cells in lines)


def _settle(path: Path, asked: dict[str, Any]) -> None:
    """Write the configuration; if one is there already, it has to be the same.

    A table or plot without a configuration is somebody else's, and stays.
    """
    if not path.exists():
        taken = [path.with_suffix(end) for end in RESULTS if path.with_suffix(end).exists()]
        if taken:
            raise RecordError(
                str(taken[0]),
                "a file that no experiment wrote",
                f"a folder without {', '.join(each.name for each in taken)}",
                "Choose another --out.",
            )
        _write(path, asked)
        return
    was = _load(path)
    differ = _differences(was, asked)
    if differ or list(was.get("arms", ())) != list(asked.get("arms", ())):
        more = f"; and {len(differ) - _SAID} more" if len(differ) > _SAID else ""
        raise RecordError(
            str(path),
            "; ".join(differ[:_SAID]) + more or "the same arms in another order",
            "the configuration that the folder was begun with",
            "Choose another --out, or repeat the command as it was.",
        )


def _differences(was: Any, now: Any, name: str = "") -> list[str]:
    """What differs between plain values, in words; keys of nested dicts are joined with dots."""
    if not (isinstance(was, dict) and isinstance(now, dict)):
        return [] if was == now else [f"{name} was {was} and is {now}"]
    said = []
    for key in dict.fromkeys((*was, *now)):
        inner = f"{name}.{key}" if name else key
        if key in was and key in now:
            said += _differences(was[key], now[key], inner)
        else:
            said.append(f"{inner} is {'missing' if key in was else 'new'}")
    return said


def _csv(rows: Sequence[dict[str, Any]]) -> str:
    sheet = io.StringIO()
    writer = csv.DictWriter(sheet, rows[0].keys(), lineterminator="\n")
    writer.writeheader()
    writer.writerows(rows)
    return sheet.getvalue()


def _load(path: Path) -> dict[str, Any]:
    with _FILE.reading(path) as reading:
        content = reading.json()
        if not isinstance(content, dict):
            raise ValueError("not an object")
        return content


def _write(path: Path, content: dict[str, Any]) -> None:
    with replacing(path) as temporary:
        temporary.write_text(json.dumps(strict(content), indent=1) + "\n", encoding="utf-8")
