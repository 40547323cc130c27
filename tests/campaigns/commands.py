"""``cd tests && python -m campaigns.commands``: runs commands on broken files, and prints a table.

Each runs in a child of its own, which may raise, hang or die. The exit code is 1 if one did, or
if it gave nonsense without a word.
"""

import argparse
import json
import os
import random
import resource
import select
import shutil
import signal
import socket
import sys
import tempfile
import time
import traceback
import warnings
from collections import Counter
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import torch
from campaigns.fuzz.mutate import mutated
from click.testing import CliRunner
from core.hostile import camera_entry
from finetune import tiny

from fragprune_plugins.files import sidecar
from fragprune_plugins.files.ply import write_ply
from fragprune_plugins.learning.thresholds import ThresholdStore
from fragprune_plugins.workbench.commands import cli

FINE = ("fine", "stated", "warned")
BAD = ("traceback", "hang", "crash", "nonsense")
PATIENCE = 60.0  # seconds for one command on a small scene, on a busy machine
MEMORY = 3 << 30  # bytes beyond what a Python with torch has

Outcome = tuple[str, str]
"""One of FINE or BAD, and words about it."""


@dataclass
class Result:
    """Outcomes of many inputs, and words about bad ones."""

    outcomes: Counter[str] = field(default_factory=Counter)
    found: list[str] = field(default_factory=list)

    def note(self, name: str, outcome: Outcome) -> None:
        self.outcomes[outcome[0]] += 1
        if outcome[0] in BAD:
            self.found.append(f"{outcome[0]}: {name}: {outcome[1]}")


def in_child(act: Callable[[], Outcome], patience: float = PATIENCE) -> Outcome:
    """Call a function in a child; its answer, or how the child ended."""
    out, into = os.pipe()
    child = os.fork()
    if child == 0:
        os.close(out)
        try:
            answer = _bounded(act)
        except BaseException as error:
            answer = "traceback", _last(error)
        os.write(into, json.dumps([answer[0], answer[1][:2000]]).encode())
        os._exit(0)
    os.close(into)
    ready, _, _ = select.select([out], [], [], patience)
    if not ready:
        os.kill(child, signal.SIGKILL)
    with open(out, "rb") as answers:
        text = answers.read()
    _, status = os.waitpid(child, 0)
    if not ready:
        return "hang", f"after {patience:g} s"
    if not text:
        return "crash", f"signal {status & 127}"
    kind, words = json.loads(text)
    return kind, words


def _bounded(act: Callable[[], Outcome]) -> Outcome:
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
    ours = [each for each in frames if "fragprune" in each.filename] or frames[-1:]
    return f"{type(error).__name__}: {str(error)[:200]} ({ours[-1].filename}:{ours[-1].lineno})"


def command(*words: object) -> Outcome:
    """Run a command of ours in this process."""
    done = CliRunner().invoke(cli, [*map(str, words), "--json"])
    if done.exception is not None and not isinstance(done.exception, SystemExit):
        return "traceback", _last(done.exception)
    try:
        printed = json.loads(done.stdout)
    except ValueError:
        return "nonsense", f"--json printed {done.stdout[:80]!r}"
    if done.exit_code == 0:
        return ("warned" if printed.get("warnings") else "fine"), ""
    error = printed.get("error")
    if error and not all(error[part] for part in ("where", "found", "expected", "remedy")):
        return "nonsense", f"an error without words: {error}"
    return "stated", ""


@dataclass(frozen=True)
class Scene:
    """COLMAP data, a model of 40 Gaussians with a sidecar, a fine-tuned one, and cameras."""

    folder: Path

    @property
    def model(self) -> Path:
        return self.folder / "model.ply"

    def make(self) -> None:
        truth = tiny.random_model(40)
        tiny.write_colmap(self.folder / "data", tiny.photographs(truth), binary=True)
        write_ply(self.model, truth)
        store = ThresholdStore.from_falloff(torch.full((40,), 0.3))
        sidecar.save(self.model, store, settings={"iterations": 3})
        ended = in_child(lambda: command(*self.words("finetune")))
        if ended[0] not in FINE[::2]:
            raise RuntimeError(f"finetune of a good scene: {ended}")
        (self.folder / "cameras.json").write_text(json.dumps([camera_entry()]))

    def words(self, name: str) -> list[object]:
        """The words of a command that reads the scene."""
        data, out = ["--data", self.folder / "data"], ["--out", self.folder / "out"]
        tuned = self.folder / "tuned.ply"
        more: dict[str, list[object]] = {
            "render": [self.model, *data, *out, "--views", "all"],
            "orbit": [self.model, "--cameras", self.folder / "cameras.json", *out],
            "profile": [self.model, *data, "--views", "all"],
            "compare": [self.model, tuned],
            "finetune": [self.model, *data, "--out", tuned, "--iters", 1, "--again"],
            "export": [self.model, "--out", self.folder / "e.ply"],
            "report": [self.folder],
        }
        drawn = [] if name == "export" else ["--threads", 1]
        return ["render" if name == "orbit" else name, *more[name], *drawn]


SURFACES: dict[str, tuple[str, tuple[str, ...]]] = {
    "a model": ("model.ply", ("render", "export")),
    "a sidecar": (f"model{sidecar.SUFFIX}", ("render", "finetune")),
    "cameras of COLMAP": ("data/sparse/0/cameras.bin", ("render",)),
    "images of COLMAP": ("data/sparse/0/images.bin", ("render",)),
    "a photograph": ("data/images/view01.png", ("profile",)),
    "cameras.json": ("cameras.json", ("orbit",)),
    "a record": ("tuned.fragprune.json", ("report", "compare")),
}
"""By name: the file that is broken, and the commands that read it."""


@contextmanager
def fresh(folder: Path) -> Iterator[Scene]:
    """A copy of the scene for one input."""
    kept, used = Scene(folder / "kept"), folder / "used"
    if not kept.folder.exists():
        kept.folder.mkdir()
        kept.make()
    shutil.copytree(kept.folder, used)
    try:
        yield Scene(used)
    finally:
        shutil.rmtree(used, ignore_errors=True)


def broken(folder: Path, name: str, count: int, seed: int) -> Result:
    """Commands on a file that was changed at random, or that is a pipe, a folder or a device."""
    place, commands = SURFACES[name]
    result = Result()
    for number in range(count + len(_SPECIAL)):
        with fresh(folder) as scene:
            file = scene.folder / place
            if number < count:
                dice = random.Random(f"{seed} {name} {number}")
                file.write_bytes(mutated(dice, [file.read_bytes()]))
            else:
                file.unlink()
                _SPECIAL[number - count](file)
            for each in commands:
                outcome = in_child(lambda s=scene, each=each: command(*s.words(each)))
                result.note(f"{each}, {number}", outcome)
    return result


_SPECIAL: tuple[Callable[[Path], Any], ...] = (
    os.mkfifo,
    lambda file: file.symlink_to("/dev/zero"),
    Path.mkdir,
)


def network(folder: Path, *names: str) -> Result:
    """Commands, all unless some are named, with sockets that refuse to be made."""

    def closed(*words: object) -> Outcome:
        tried: list[None] = []

        def refuse(*_: Any, **__: Any) -> None:
            tried.append(None)
            raise OSError("no network")

        for name in ("socket", "create_connection", "getaddrinfo"):
            setattr(socket, name, refuse)
        outcome = command(*words)
        return ("nonsense", f"{len(tried)} attempts") if tried else outcome

    result = Result()
    every = ("render", "orbit", "profile", "compare", "finetune", "export", "report")
    for name in names or every:
        with fresh(folder) as scene:
            outcome = in_child(lambda s=scene, name=name: closed(*s.words(name)), 2 * PATIENCE)
            bad = outcome[0] == "stated"
            result.note(name, ("nonsense", "a good scene was refused") if bad else outcome)
    return result


def main() -> int:
    """Run all, and print the table."""
    parser = argparse.ArgumentParser(prog="python -m campaigns.commands", description=__doc__)
    parser.add_argument("--inputs", type=int, default=50, help="random ones of each file (50)")
    parser.add_argument("--seed", type=int, default=int(time.time()), help="default: the clock")
    words = parser.parse_args()
    torch.set_num_threads(1)
    print(f"seed {words.seed}", file=sys.stderr)
    total = Result()
    print("| broken | inputs | " + " | ".join((*FINE, *BAD)) + " |")
    print("|---|" + "---|" * (1 + len(FINE) + len(BAD)))
    with tempfile.TemporaryDirectory(prefix="campaign-") as name:
        folder = Path(name)
        row("nothing, without a network", network(folder), total)
        for surface in SURFACES:
            row(surface, broken(folder, surface, words.inputs, words.seed), total)
    row("all", total, Result())
    return 1 if total.found else 0


def row(name: str, result: Result, total: Result) -> None:
    """Print a line of the table, and what was found."""
    total.outcomes += result.outcomes
    total.found += result.found
    cells = " | ".join(str(result.outcomes[kind]) for kind in (*FINE, *BAD))
    print(f"| {name} | {result.outcomes.total():,} | {cells} |", flush=True)
    for each in result.found[:20]:
        print(f"    {each}", file=sys.stderr, flush=True)


if __name__ == "__main__":
    raise SystemExit(main())
