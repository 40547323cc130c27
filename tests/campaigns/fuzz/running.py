"""Feeds inputs to readers in a child of bounded memory, and watches it."""

import multiprocessing
import os
import random
import resource
import shutil
import sys
import tempfile
import time
import warnings
from collections import Counter
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
_FORK = multiprocessing.get_context("fork")


@dataclass
class Tally:
    """How many inputs ended in each way; of like bad ones the first: (kind, words, input)."""

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


def broken(name: str, pool: list[bytes], seed: int, number: int) -> bytes:
    """An input of a seed, by its number, made of a reader's."""
    return mutated(random.Random(f"{seed} {name} {number}"), pool)


def run(reader: Reader, count: int, *, seed: int = 0, seconds: float = 1e9) -> Tally:
    """Feed up to ``count`` inputs to a reader, for up to so many seconds in all."""
    tally, first, end = Tally(), 0, time.monotonic() + seconds
    reader.pool()  # made once, for all children
    memory = "/dev/shm" if os.path.isdir("/dev/shm") else None
    with tempfile.TemporaryDirectory(prefix="fuzz-", dir=memory) as folder:
        while first < count and time.monotonic() < end:
            place = Path(folder, str(first))  # what a child that died left stays where it is
            first = _child(reader, tally, range(first, count), seed, (place, end))
    return tally


def _child(reader: Reader, tally: Tally, numbers: range, seed: int, how: tuple[Path, float]) -> int:
    """Let one child go on until it ends; returns the number of the next input."""
    outcomes, told = _FORK.Pipe(duplex=False)
    child = _FORK.Process(target=_feed, args=(told, reader, numbers, seed, *how))
    child.start()
    told.close()
    for number in numbers:
        if not outcomes.poll(HANG):
            child.kill()
            kind, words = "hang", ""
        else:
            try:
                kind, words = outcomes.recv()
            except EOFError:
                child.join()
                if not child.exitcode:  # the time is up
                    return numbers.stop
                kind, words = "crash", f"status {child.exitcode}"
        content = broken(reader.name, reader.pool(), seed, number) if kind in BAD else b""
        tally.note(kind, words, content)
        if kind in ("hang", "crash"):
            child.join()
            return number + 1
    child.join()
    return numbers.stop


def _feed(told, reader, numbers, seed, place, end):
    """In the child: one input after the other, until the last or until the time is up."""
    warnings.simplefilter("ignore")
    os.dup2(os.open(os.devnull, os.O_WRONLY), 2)
    if sys.platform == "linux":
        pages = int(Path("/proc/self/statm").read_text().split()[0])
        limit = pages * resource.getpagesize() + MEMORY
        resource.setrlimit(resource.RLIMIT_AS, (limit, limit))
    resource.setrlimit(resource.RLIMIT_CORE, (0, 0))
    pool = reader.pool()
    for number in numbers:
        if time.monotonic() > end:
            break
        kind, words = judge(reader, broken(reader.name, pool, seed, number), place)
        told.send((kind, " ".join(words.split()) if kind in BAD else ""))
