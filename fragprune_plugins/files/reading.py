"""Files that somebody else may have written.

An ``UntrustedFile`` opens regular files only, so it never waits for a pipe or a device, and bounds
their size. What a parser raises becomes its one error, with path and place.
"""

from __future__ import annotations

import contextlib
import io
import json
import os
import stat
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any, BinaryIO

from fragprune_plugins.errors import FragpruneError, InputError

MEBIBYTE = 1 << 20

NESTING = 64  # most levels of a JSON value; what we read has six at most
_SAID = 200  # characters of a parser's own words


class _Bounded(io.BufferedReader):
    """A file that allocates no more for a read than it has bytes left; Python's own does."""

    def read(self, size: int | None = -1, /) -> bytes:
        """Read up to ``size`` bytes."""
        if size is not None and size > MEBIBYTE:
            size = min(size, max(0, os.fstat(self.fileno()).st_size - self.tell()))
        return super().read(size)


@dataclass
class Reading:
    """A file that is being read.

    Attributes:
        file: open, at its beginning.
        place: where in the file the parser is, in words for a message; "" where there is none.
    """

    path: Path
    file: BinaryIO
    size: int
    place: str = ""

    @property
    def left(self) -> int:
        """Bytes from here to the end."""
        return self.size - self.file.tell()

    def take(self, count: int) -> bytes:
        """Read exactly so many bytes; EOFError, and nothing allocated, if the file has fewer."""
        self._expect(count)
        return self.file.read(count)

    def skip(self, count: int) -> None:
        """Go on so many bytes; raises as ``take`` does."""
        self._expect(count)
        self.file.seek(count, os.SEEK_CUR)

    def _expect(self, count: int) -> None:
        if count > self.left:
            at = self.file.tell()
            raise EOFError(f"{count} bytes announced at byte {at}, where {self.left} are left")

    def text(self) -> str:
        """The rest of the file as UTF-8, with or without the mark that Windows begins it with."""
        return self.file.read().decode("utf-8-sig")

    def json(self) -> Any:
        """The rest of the file as a JSON value of at most ``NESTING`` levels."""
        return parse_json(self.text())


@dataclass(frozen=True)
class UntrustedFile:
    """How files of one kind are opened, and what is said where one cannot be read.

    Attributes:
        error: the class of every error.
        broken: what is said of a file that cannot be parsed, such as "not readable as PLY".
        expected: what the file should be.
        missing: what to do about a file that is missing.
        noun: what is missing then.
    """

    error: type[FragpruneError]
    broken: str
    expected: str
    remedy: str
    limit: int = 1 << 40
    missing: str = "Check the path."
    noun: str = "file"

    @contextlib.contextmanager
    def reading(self, path: str | Path) -> Iterator[Reading]:
        """Open a file for the length of a block, and state whatever the block raises.

        Raises:
            FragpruneError: its ``error``, for no regular file, one larger than ``limit``, or what
                the block raised, an InputError too. Other errors of fragprune pass.
        """
        path = Path(path)
        with self.stated(path) as reading, self._open(path) as file:
            reading.file, reading.size = file, os.fstat(file.fileno()).st_size
            if reading.size > self.limit:
                found = f"{reading.size} bytes, more than such a file has"
                raise self.error(str(path), found, f"at most {self.limit} bytes", self.remedy)
            if file.peek().startswith(b"version https://git-lfs.github.com/"):
                raise self.error(str(path), "git's pointer", self.expected, "Run: git lfs pull")
            yield reading

    @contextlib.contextmanager
    def stated(self, path: Path) -> Iterator[Reading]:
        """State whatever a block raises about a path, as ``reading`` does, without opening it."""
        reading = Reading(path, None, 0)  # type: ignore[arg-type] # the caller opens it
        try:
            yield reading
        except InputError as error:
            at = f"{reading.place}: " if reading.place else ""
            found = f"{at}{error.where}: {error.found}"
            raise self.error(str(path), found, error.expected, self.remedy) from error
        except FragpruneError:
            raise
        except Exception as error:
            at = f" at {reading.place}" if reading.place else ""
            found = f"{self.broken}{at} ({message_of(error)})"
            raise self.error(str(path), found, self.expected, self.remedy) from error

    def _open(self, path: Path) -> _Bounded:
        """Open a regular file without waiting for anything."""
        try:
            self._expect_regular(path, path.stat().st_mode)  # opening a device may do something
            # Without O_NONBLOCK, a pipe put there meanwhile would wait for a writer.
            flags = os.O_RDONLY | getattr(os, "O_NONBLOCK", 0) | getattr(os, "O_BINARY", 0)
            file = _Bounded(io.FileIO(os.open(path, flags)))
        except FileNotFoundError as error:
            raise self._absent(path, f"no such {self.noun}") from error
        except (OSError, ValueError) as error:  # ValueError: a NUL in the name
            why = getattr(error, "strerror", None) or str(error)
            raise self._absent(path, f"cannot be opened ({why})") from error
        try:
            self._expect_regular(path, os.fstat(file.fileno()).st_mode)
        except BaseException:
            file.close()
            raise
        return file

    def _expect_regular(self, path: Path, mode: int) -> None:
        if not stat.S_ISREG(mode):
            kind = "a folder" if stat.S_ISDIR(mode) else "no regular file, but a pipe or device"
            raise self._absent(path, kind)

    def _absent(self, path: Path, found: str) -> FragpruneError:
        return self.error(str(path), found, self.expected, self.missing)


def lies_in(path: Path, folder: Path) -> bool:
    """Whether a path is in a folder once all links of both are followed."""
    with contextlib.suppress(OSError, ValueError):  # a NUL in the name
        return Path(os.path.realpath(path)).is_relative_to(os.path.realpath(folder))
    return False


def parse_json(text: str) -> Any:
    """The JSON value of a text.

    Raises:
        ValueError: the text is not JSON, or nests deeper than ``NESTING``.
        RecursionError: it nests so deeply that Python's own reader gives up.
    """
    value = json.loads(text)
    level = [value]
    for _ in range(NESTING):
        level = [
            inner
            for outer in level
            if isinstance(outer, dict | list)
            for inner in (outer.values() if isinstance(outer, dict) else outer)
        ]
        if not level:
            return value
    raise ValueError(f"more than {NESTING} levels")


def message_of(error: BaseException) -> str:
    """What an error says, as one line of bounded length."""
    if isinstance(error, RecursionError):
        return "nested too deeply"
    if isinstance(error, MemoryError):
        return "it takes more memory than there is"
    if isinstance(error, KeyError) and error.args:
        return f"no {error.args[0]!r}"[:_SAID]
    text = " ".join(str(error)[: 4 * _SAID].split())
    return (text if len(text) <= _SAID else text[:_SAID] + "...") or type(error).__name__
