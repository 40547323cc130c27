"""Runs each attack in a child of its own, which may raise, hang or die."""

from __future__ import annotations

import json
import os
import resource
import select
import signal
import sys
import time
import traceback
import warnings
from collections import Counter
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from attack.hostile import GOOD
from click.testing import CliRunner

from fragprune_plugins.errors import FragpruneError
from fragprune_plugins.workbench.commands import cli

FINE = ("fine", "stated", "warned")
BAD = ("traceback", "hang", "crash", "nonsense")

PATIENCE = 60.0
"""Seconds that one command on a small scene may take, on a busy machine."""

MEMORY = 3 << 30
"""Bytes that one may take beyond what a Python with torch has."""

Outcome = tuple[str, str]
"""One of FINE or BAD, and words about it."""


@dataclass
class Result:
    """What became of an attack.

    Attributes:
        inputs: how many, and of what.
        outcomes: how many of each.
        found: words about bad ones.
    """

    outcomes: Counter[str] = field(default_factory=Counter)
    found: list[str] = field(default_factory=list)

    @property
    def inputs(self) -> int:
        return sum(self.outcomes.values())

    @property
    def bad(self) -> int:
        return sum(self.outcomes[kind] for kind in BAD)

    def note(self, name: str, outcome: Outcome) -> None:
        kind, words = outcome
        self.outcomes[kind] += 1
        if kind in BAD:
            self.found.append(f"{kind}: {name}: {words}")


def in_child(act: Callable[[], Outcome], patience: float = PATIENCE) -> Outcome:
    """Call a function in a child; its answer, or how it ended."""
    out, into = os.pipe()
    sys.stdout.flush()
    child = os.fork()
    if child == 0:
        os.close(out)
        try:
            answer = _guarded(act)
        except BaseException as error:
            answer = "traceback", _last(error)
        os.write(into, json.dumps([answer[0], answer[1][:2000]]).encode())
        os._exit(0)
    os.close(into)
    try:
        ready, _, _ = select.select([out], [], [], patience)
        if not ready:
            os.kill(child, signal.SIGKILL)
            os.waitpid(child, 0)
            return "hang", f"after {patience:g} s"
        text = b""
        while piece := os.read(out, 1 << 16):
            text += piece
        _, status = os.waitpid(child, 0)
    finally:
        os.close(out)
    if not text:
        return "crash", f"signal {status & 127}"
    kind, words = json.loads(text)
    return kind, words


def _guarded(act: Callable[[], Outcome]) -> Outcome:
    warnings.simplefilter("ignore")
    quiet = os.open(os.devnull, os.O_RDWR)
    for descriptor in (0, 1, 2):
        os.dup2(quiet, descriptor)
    resource.setrlimit(resource.RLIMIT_CORE, (0, 0))
    if sys.platform == "linux":
        pages = int(Path("/proc/self/statm").read_text().split()[0])
        limit = pages * resource.getpagesize() + MEMORY
        resource.setrlimit(resource.RLIMIT_AS, (limit, limit))
    return act()


def _last(error: BaseException) -> str:
    frames = traceback.extract_tb(error.__traceback__)
    ours = [each for each in frames if "fragprune" in each.filename] or list(frames[-1:])
    place = f"{Path(ours[-1].filename).name}:{ours[-1].lineno}" if ours else ""
    return f"{type(error).__name__}: {str(error)[:200]} ({place})"


def command(*words: object) -> Outcome:
    """Run a command of ours in this process: fine, warned, stated, or a traceback."""
    done = CliRunner().invoke(cli, [*map(str, words), "--json"])
    if done.exception is not None and not isinstance(done.exception, SystemExit):
        return "traceback", _last(done.exception)
    try:
        said = json.loads(done.stdout)
    except ValueError:
        return "nonsense", f"--json printed {done.stdout[:80]!r}"
    if done.exit_code == 0:
        return ("warned" if said.get("warnings") else "fine"), ""
    error = said.get("error")
    if error is None:  # check prints its findings
        return "stated", ""
    if not all(error[part] for part in ("code", "where", "found", "expected", "remedy")):
        return "nonsense", f"an error without words: {error}"
    return "stated", f"[{error['code']}] {error['where']}: {error['found']}"


def judged(name: str, outcome: Outcome) -> Outcome:
    """An outcome in the light of what had to become of the input."""
    kind, words = outcome
    good = name.startswith(GOOD)
    if good and kind == "stated":
        return "nonsense", f"a good input was refused: {words}"
    if not good and kind == "fine":
        return "nonsense", "accepted without a word"
    return outcome


def raised(act: Callable[[], Any]) -> Outcome:
    """Call a function of ours; fine, stated, or a traceback."""
    try:
        act()
    except FragpruneError as error:
        return "stated", str(error)
    except Exception as error:
        return "traceback", _last(error)
    return "fine", ""


def timed(act: Callable[[], Result]) -> tuple[Result, float]:
    """The result of an attack, and its seconds."""
    begun = time.monotonic()
    return act(), time.monotonic() - begun


def table(rows: Sequence[tuple[str, Result, float]]) -> str:
    """The table in Markdown."""
    kinds = (*FINE, *BAD)
    lines = [
        f"| attack | inputs | {' | '.join(kinds)} | s |",
        f"|---|{'---|' * (len(kinds) + 2)}",
    ]
    total = Result()
    for name, result, seconds in rows:
        total.outcomes += result.outcomes
        lines.append(_row(name, result, f"{seconds:.0f}"))
    return "\n".join([*lines, _row("all", total, f"{sum(each[2] for each in rows):.0f}")])


def _row(name: str, result: Result, seconds: str) -> str:
    cells = [str(result.outcomes[kind]) for kind in (*FINE, *BAD)]
    return f"| {name} | {result.inputs:,} | {' | '.join(cells)} | {seconds} |"
