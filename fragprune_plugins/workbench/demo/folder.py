"""The demo's folder. A marker lists the files that a demo wrote; only these are ever deleted."""

from __future__ import annotations

import contextlib
import json
from collections.abc import Iterator
from pathlib import Path

from fragprune_plugins.errors import OutputError
from fragprune_plugins.files.atomic import digest, replacing
from fragprune_plugins.files.reading import MEBIBYTE, UntrustedFile
from fragprune_plugins.workbench.models.model import writable_folder

MARKER = ".fragprune-demo"
"""JSON with "files": SHA-256 of each file that the demo wrote, by path in the folder."""

_FILE = UntrustedFile(OutputError, "no list", "a list of files", "Remove it.", limit=MEBIBYTE)

_REMEDY = "Choose another --out, or move your files away and delete the others yourself."


def clear(out: Path) -> None:
    """Make the folder, or delete an earlier demo's files, from which training would resume.

    Files whose names begin with a dot, such as those of file managers, are ignored and kept.

    Raises:
        OutputError: the folder cannot be written, or holds a file that no demo wrote or that was
            changed since. Then nothing is deleted.
    """
    writable_folder(out)
    ours, found = _listed(out), _files(out)
    for name, path in found.items():
        if path.is_symlink() or name not in ours:
            raise _refusal(out, f"holds {name!r}, which no demo wrote")
        if digest(path) != ours[name]:
            raise _refusal(out, f"holds {name!r}, changed since a demo wrote it")
    for path in found.values():
        path.unlink()
    for folder in sorted({up for path in found.values() for up in path.parents}, reverse=True):
        if out in folder.parents:
            with contextlib.suppress(OSError):  # the folder holds a hidden file
                folder.rmdir()
    _list(out, {})


@contextlib.contextmanager
def claiming(out: Path, *names: str) -> Iterator[None]:
    """After the block, list files and folders of these names, which it writes, in the marker.

    This happens also if the block fails, so that the next demo can delete them.
    """
    try:
        yield
    finally:
        made = {
            name: digest(path) for name, path in _files(out).items() if name.split("/")[0] in names
        }
        _list(out, _listed(out) | made)


def _files(out: Path) -> dict[str, Path]:
    """All files that are not hidden, by path in ``out``; links count as files."""
    found = {p.relative_to(out).as_posix(): p for p in out.rglob("*")}
    return {
        name: path
        for name, path in sorted(found.items())
        if (path.is_symlink() or not path.is_dir())
        and not any(part.startswith(".") for part in name.split("/"))
    }


def _listed(out: Path) -> dict[str, str]:
    """SHA-256 by path, as the marker lists them; {} if the marker is missing or broken."""
    try:
        with _FILE.reading(out / MARKER) as reading:
            return {str(name): str(sha) for name, sha in reading.json()["files"].items()}
    except OutputError:
        return {}


def _list(out: Path, files: dict[str, str]) -> None:
    with replacing(out / MARKER) as path:
        path.write_text(json.dumps({"files": files}, indent=1) + "\n", encoding="utf-8")


def _refusal(out: Path, found: str) -> OutputError:
    return OutputError(str(out), found, "a new or empty folder, or an earlier demo's", _REMEDY)
