"""Writing files so that an existing one is never left half-written."""

from __future__ import annotations

import contextlib
import hashlib
import os
import tempfile
from collections.abc import Iterator
from pathlib import Path

from fragprune_plugins.errors import OutputError


@contextlib.contextmanager
def replacing(path: Path) -> Iterator[Path]:
    """Yield a temporary path in the same folder. On success it is renamed to ``path``.

    If anything fails inside, ``path`` stays as it was and the temporary file is removed.

    Raises:
        OutputError: the folder or file cannot be written.
    """
    path = Path(path)
    temporary: Path | None = None
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        handle, name = tempfile.mkstemp(
            dir=path.parent, prefix=f".{path.name}.", suffix=path.suffix
        )
        os.close(handle)
        temporary = Path(name)
        yield temporary
        # mkstemp makes private files; give this one the permissions a plain open() would.
        umask = os.umask(0)
        os.umask(umask)
        temporary.chmod(0o666 & ~umask)
        os.replace(temporary, path)
    except OSError as error:
        raise OutputError(
            str(path),
            f"cannot be written ({error.strerror or error})",
            "a writable place",
            "Choose another output, or free space and permissions there.",
        ) from error
    finally:
        if temporary is not None:
            temporary.unlink(missing_ok=True)


def writable_folder(path: Path) -> Path:
    """Create the folder if it is missing, and check that a file can be made in it; returns it.

    Raises:
        OutputError: the folder cannot be written.
    """
    path = Path(path)
    try:
        path.mkdir(parents=True, exist_ok=True)
        with tempfile.TemporaryFile(dir=path):
            pass
    except OSError as error:
        raise OutputError(
            str(path),
            f"cannot be written ({error.strerror or error})",
            "a folder one can write to",
            "Choose another output folder.",
        ) from error
    return path


def digest(path: Path) -> str:
    """The SHA-256 digest of a file, hexadecimal."""
    sha = hashlib.sha256()
    with open(path, "rb") as file:
        while block := file.read(1 << 20):
            sha.update(block)
    return sha.hexdigest()
