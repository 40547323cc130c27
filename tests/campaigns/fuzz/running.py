"""Feeds inputs to readers in a child of bounded memory, and watches it."""

import mmap
import os
import random
import resource
import shutil
import signal
import struct
import sys
import tempfile
import time
from collections import Counter
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path

from campaigns.fuzz.mutate import mutated
from campaigns.fuzz.readers import Nonsense, Reader

import fragprune_plugins
from fragprune_plugins.errors import FragpruneError

GOOD = ("read", "stated")
BAD = ("foreign", "nonsense", "slow", "memory", "crash", "hang")

MEMORY = 1 << 30
"""Bytes that a child may take beyond what it has when it begins."""

SLOW = 5.0
"""CPU seconds that no input of at most 64 KiB may take."""

HANG = 60.0
"""Seconds after which a child is given up."""

_OURS = str(Path(fragprune_plugins.__file__).parent)
_STATE = struct.Struct("<qd")  # the input in hand, and when it was taken


@dataclass
class Tally:
    """What became of a reader's inputs.

    Attributes:
        outcomes: how many of each kind.
        found: (kind, words, input) of each bad one; of like ones the first.
    """

    outcomes: Counter[str] = field(default_factory=Counter)
    found: dict[tuple[str, str], bytes] = field(default_factory=dict)

    @property
    def inputs(self) -> int:
        return sum(self.outcomes.values())

    @property
    def bad(self) -> int:
        return sum(self.outcomes[kind] for kind in BAD)

    def note(self, kind: str, words: str, content: bytes) -> None:
        self.outcomes[kind] += 1
        if kind in BAD and len(self.found) < 200:
            self.found.setdefault((kind, words), content)


def scratch() -> Path:
    """A folder in memory, if there is such a place."""
    shared = Path("/dev/shm")
    return Path(tempfile.mkdtemp(prefix="fuzz-", dir=shared if shared.is_dir() else None))


def judge(reader: Reader, content: bytes, folder: Path) -> tuple[str, str]:
    """Let a reader read an input; returns the kind of outcome, and words about it."""
    folder.mkdir()
    file = folder / "input"
    file.write_bytes(content)
    begun = time.process_time()
    try:
        reader.read(file)
        kind, words = "read", ""
    except FragpruneError as error:
        kind, words = "stated", str(error)
        if "more memory than there is" in words:
            kind = "memory"
        elif not (error.where and error.found and error.expected and error.remedy):
            kind = "nonsense"
    except Nonsense as error:
        kind, words = "nonsense", str(error)
    except Exception as error:
        kind, words = "foreign", f"{type(error).__name__} {_place(error)}"
    finally:
        shutil.rmtree(folder)
    if time.process_time() - begun > SLOW:
        return "slow", words
    return kind, words


def _place(error: BaseException) -> str:
    """The innermost line of ours in a traceback."""
    place, step = "", error.__traceback__
    while step is not None:
        name = step.tb_frame.f_code.co_filename
        if name.startswith(_OURS):
            place = f"{name.removeprefix(_OURS)}:{step.tb_lineno}"
        step = step.tb_next
    return place


def inputs(pool: list[bytes], name: str, seed: int, first: int) -> Iterator[tuple[int, bytes]]:
    """Inputs of a seed, from a number on."""
    number = first
    while True:
        yield number, mutated(random.Random(f"{seed} {name} {number}"), pool)
        number += 1


def run(reader: Reader, count: int, *, seed: int = 0, seconds: float = 1e9) -> Tally:
    """Feed up to ``count`` inputs to a reader, for up to so many seconds.

    Args:
        reader: of READERS.
        count: inputs.
        seed: of the inputs.
        seconds: wall clock, for all.
    """
    tally, folder = Tally(), scratch()
    shared = mmap.mmap(-1, _STATE.size)
    end = time.monotonic() + seconds
    try:
        first = 0
        while first < count and time.monotonic() < end:
            first = _child(reader, tally, folder, shared, (first, count, seed, end))
    finally:
        shutil.rmtree(folder, ignore_errors=True)
    return tally


def _child(
    reader: Reader,
    tally: Tally,
    folder: Path,
    shared: mmap.mmap,
    task: tuple[int, int, int, float],
) -> int:
    """Let one child go on until it ends; returns the number of the next input."""
    first, count, *_ = task
    log, current = folder / "log", folder / "current"
    log.write_bytes(b"")
    shutil.rmtree(folder / "input", ignore_errors=True)  # of a child that died
    shared[:] = _STATE.pack(first, time.monotonic())
    sys.stdout.flush()
    child = os.fork()
    if child == 0:
        status = 3
        try:
            _feed(reader, folder, shared, *task)
            status = 0
        finally:
            os._exit(status)
    hung = False
    while True:
        ended, status = os.waitpid(child, os.WNOHANG)
        if ended:
            break
        if time.monotonic() - _STATE.unpack(shared[:])[1] > HANG:
            os.kill(child, signal.SIGKILL)
            hung = True
        time.sleep(0.05)
    lines = log.read_text(encoding="utf-8").splitlines()
    for kind, words, content in (line.split("\t") for line in lines):
        tally.note(kind, words, bytes.fromhex(content))
    number = _STATE.unpack(shared[:])[0]
    if status:
        tally.note("hang" if hung else "crash", f"status {status}", current.read_bytes())
        return number + 1
    return max(number + 1, first + 1) if number + 1 >= count else count


def _feed(
    reader: Reader,
    folder: Path,
    shared: mmap.mmap,
    first: int,
    count: int,
    seed: int,
    end: float,
) -> None:
    """In the child: one input after the other, until the count or the time is up."""
    import warnings

    warnings.simplefilter("ignore")
    os.dup2(os.open(os.devnull, os.O_WRONLY), 2)
    pages = int(Path("/proc/self/statm").read_text().split()[0]) if sys.platform == "linux" else 0
    if pages:
        limit = pages * resource.getpagesize() + MEMORY
        resource.setrlimit(resource.RLIMIT_AS, (limit, limit))
    resource.setrlimit(resource.RLIMIT_CORE, (0, 0))
    with (folder / "log").open("w", encoding="utf-8") as log:
        for number, content in inputs(reader.pool(), reader.name, seed, first):
            if number >= count or time.monotonic() > end:
                break
            (folder / "current").write_bytes(content)
            shared[:] = _STATE.pack(number, time.monotonic())
            kind, words = judge(reader, content, folder / "input")
            kept = content.hex() if kind in BAD else ""
            log.write(f"{kind}\t{' '.join(words.split()) if kind in BAD else ''}\t{kept}\n")
            log.flush()
