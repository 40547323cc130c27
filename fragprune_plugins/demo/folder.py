"""The demo's folder: a marker in it lists what the demo wrote, and nothing else is ever deleted."""

from __future__ import annotations

import contextlib
import json
from collections.abc import Iterator
from pathlib import Path

from fragprune_plugins.errors import OutputError
from fragprune_plugins.storage.atomic import digest, replacing, writable_folder

MARKER = ".fragprune-demo"
"""JSON: "files", the SHA-256 of each file that the demo wrote, by its path in the folder."""

_REMEDY = "Choose another --out, or move away what you want to keep and delete the rest yourself."


def clear(out: Path) -> None:
    """Make the folder, or empty it of an earlier demo, whose checkpoints would be taken up again.

    Files whose names begin with a dot, as file managers leave them, neither count nor go.

    Raises:
        OutputError: it cannot be written, or holds a file that no demo wrote or that was changed
            since; nothing is deleted then.
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
        if folder.is_relative_to(out) and folder != out:
            with contextlib.suppress(OSError):  # a hidden file is in it
                folder.rmdir()
    _list(out, {})


@contextlib.contextmanager
def claiming(out: Path, *names: str) -> Iterator[None]:
    """The demo writes files and folders of these names in the block: they are its own afterwards.

    Also when the block fails, so that the next demo may delete them.
    """
    try:
        yield
    finally:
        made = {
            name: digest(path) for name, path in _files(out).items() if name.split("/")[0] in names
        }
        _list(out, _listed(out) | made)


def _files(out: Path) -> dict[str, Path]:
    """All that is not a folder and not hidden, by its path in ``out``; links are not followed."""
    found = {p.relative_to(out).as_posix(): p for p in out.rglob("*")}
    return {
        name: path
        for name, path in sorted(found.items())
        if (path.is_symlink() or not path.is_dir())
        and not any(part.startswith(".") for part in name.split("/"))
    }


def _listed(out: Path) -> dict[str, str]:
    """What the marker says; nothing where there is none, or a broken one."""
    try:
        files = json.loads((out / MARKER).read_text(encoding="utf-8"))["files"]
        return {str(name): str(sha) for name, sha in files.items()}
    except (OSError, ValueError, KeyError, TypeError, AttributeError):
        return {}


def _list(out: Path, files: dict[str, str]) -> None:
    with replacing(out / MARKER) as path:
        path.write_text(json.dumps({"files": files}, indent=1) + "\n", encoding="utf-8")


def _refusal(out: Path, found: str) -> OutputError:
    return OutputError(str(out), found, "a new or empty folder, or an earlier demo's", _REMEDY)
