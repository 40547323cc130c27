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

MARKER = ".fragprune-demo"  # JSON with "files": SHA-256 of each that the demo wrote, by path
_FILE = UntrustedFile(OutputError, "no list", "a list of files", "Remove it.", limit=MEBIBYTE)


def clear(out: Path) -> None:
    """Make the folder, or delete an earlier demo's files, from which training would resume.

    Files whose names begin with a dot, such as those of file managers, are ignored and kept. Where
    it holds a file that no demo wrote, or that was changed since, it is an OutputError, and nothing
    is deleted.
    """
    writable_folder(out)
    ours, found = _listed(out), _files(out)
    for name, path in found.items():
        foreign = path.is_symlink() or name not in ours
        if foreign or digest(path) != ours[name]:
            what = f"holds {name!r}, "
            what += "which no demo wrote" if foreign else "changed since a demo wrote it"
            expected = "a new or empty folder, or an earlier demo's"
            remedy = "Choose another --out, or move your files away and delete the others yourself."
            raise OutputError(str(out), what, expected, remedy)
    for path in found.values():
        path.unlink()
    for folder in sorted({up for path in found.values() for up in path.parents}, reverse=True):
        if out in folder.parents:
            with contextlib.suppress(OSError):  # the folder holds a hidden file
                folder.rmdir()
    _list(out, {})


@contextlib.contextmanager
def claiming(out: Path, *names: str) -> Iterator[None]:
    """After the block, also if it fails, list what it wrote by these names in the marker."""
    try:
        yield
    finally:
        made = {name: path for name, path in _files(out).items() if name.split("/")[0] in names}
        _list(out, _listed(out) | {name: digest(path) for name, path in made.items()})


def _files(out: Path) -> dict[str, Path]:
    """All files that are not hidden, by path in ``out``; links count as files."""
    files = (path for path in sorted(out.rglob("*")) if path.is_symlink() or not path.is_dir())
    named = {path.relative_to(out).as_posix(): path for path in files}
    return {name: path for name, path in named.items() if "/." not in f"/{name}"}


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
