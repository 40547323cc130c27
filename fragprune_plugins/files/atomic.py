"""Writing files so that an existing one is never left half-written, whatever ends the process.

On its way to a file NAME everything is called ``.fragprune-KEY-...`` beside it, KEY made from NAME.
Who writes holds the lock ``.fragprune-KEY-lock``, which the system frees when the process dies:
what lies beside a free lock was left by a dead process, and is removed.
"""

from __future__ import annotations

import contextlib
import errno
import hashlib
import os
import shutil
import tempfile
from collections.abc import Iterator
from pathlib import Path

from filelock import FileLock, Timeout

from fragprune_plugins.errors import OutputError

WAIT = 60.0  # seconds to wait for another process that writes the same file

_WITHOUT_LOCKS = {errno.ENOLCK, errno.ENOSYS, errno.ENOTSUP, errno.EOPNOTSUPP, errno.EINVAL}
_WITHOUT_LOCKS |= {errno.EACCES, errno.EPERM, errno.EROFS}  # a file, maybe, in a locked folder


def in_flight(path: Path, what: str) -> Path:
    """The name, in the same folder, of something that is on its way to a file."""
    path = Path(path)
    key = hashlib.sha256(path.name.casefold().encode(errors="surrogatepass")).hexdigest()
    return path.with_name(f".fragprune-{key[:12]}-{what}")


def all_in_flight(path: Path, what: str) -> list[Path]:
    """What lies in the folder under the names that ``in_flight`` gives for a pattern."""
    with contextlib.suppress(OSError):  # an unreadable folder holds nothing of ours
        return sorted(Path(path).parent.glob(in_flight(path, what).name))
    return []


@contextlib.contextmanager
def locked(path: Path, wait: float | None = None, what: str = "lock") -> Iterator[bool]:
    """Keep other processes out of the same block for the same file, whose folder must exist.

    Args:
        wait: seconds to wait for another process; None for ``WAIT``.
        what: tells locks of one file apart; "lock" is for writing it.

    Yields:
        Whether it is locked; False where the file system has no locks.

    Raises:
        OutputError: another process holds the lock.
    """
    name = in_flight(path, what)
    lock = FileLock(name, timeout=WAIT if wait is None else wait)
    try:
        lock.acquire(poll_interval=0.02)
    except Timeout as error:
        found = "being written by another process"
        remedy = "Wait for the other process, or choose another output."
        raise OutputError(str(path), found, "one process at a time", remedy) from error
    except (OSError, NotImplementedError) as error:  # filelock's word for ENOSYS
        if getattr(error, "errno", errno.ENOSYS) not in _WITHOUT_LOCKS:
            raise
        name.unlink(missing_ok=True)
        yield False
        return
    try:
        yield True
    finally:
        with contextlib.suppress(OSError):  # Windows keeps a file that is open
            name.unlink()  # first: whoever waits then finds that it is another file
        lock.release()


@contextlib.contextmanager
def staging(path: Path) -> Iterator[Path]:
    """Yield an empty folder beside a file, for what is to replace it; the file is locked meanwhile.

    The folder is removed at the end, and so are folders that dead processes left.

    Raises:
        OutputError: the place cannot be written, or another process writes the file.
    """
    path = Path(path)
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        if path.exists() and not (path.is_file() or path.is_dir()):
            raise OSError("a pipe or device")
        with locked(path) as alone:
            for left in all_in_flight(path, "new-*") if alone else ():
                shutil.rmtree(left, ignore_errors=True)
            prefix = in_flight(path, "new-").name
            folder = Path(tempfile.mkdtemp(dir=path.parent, prefix=prefix))
            try:
                yield folder
            finally:
                shutil.rmtree(folder, ignore_errors=True)
    except OSError as error:
        found = f"cannot be written ({error.strerror or error})"
        remedy = "Choose another output, or free space and permissions there."
        raise OutputError(str(path), found, "a writable place", remedy) from error


@contextlib.contextmanager
def replacing(path: Path, *, durable: bool = False) -> Iterator[Path]:
    """Yield the path of a file to write. On success it becomes ``path``, which else stays.

    Args:
        durable: after the block it also survives a power cut, which takes some milliseconds more.

    Raises:
        OutputError: the folder or file cannot be written, or another process writes the file.
    """
    with staging(path) as folder:
        new = folder / Path(path).name
        yield new
        if durable:
            put(new, path)
        else:
            _permit(new)
            os.replace(new, path)


def put(new: Path, path: Path) -> None:
    """Rename a finished file so that even a power cut leaves the old one or the new one, whole."""
    _permit(new)
    with open(new, "rb") as file:
        os.fsync(file.fileno())
    rename(new, path)


def _permit(new: Path) -> None:
    """Give a file a plain ``open``'s permissions; some writers make private ones."""
    umask = os.umask(0)
    os.umask(umask)
    new.chmod(0o666 & ~umask)


def rename(old: Path, new: Path) -> None:
    """Rename a file that is on the disk; when this returns, so is its new name.

    Some network folders bring names there in their own time.
    """
    os.replace(old, new)
    with contextlib.suppress(OSError):
        handle = os.open(Path(new).parent, os.O_RDONLY)
        try:
            os.fsync(handle)
        finally:
            os.close(handle)


def digest(path: Path) -> str:
    """The SHA-256 digest of a file, hexadecimal."""
    sha = hashlib.sha256()
    with open(path, "rb") as file:
        while block := file.read(1 << 20):
            sha.update(block)
    return sha.hexdigest()
