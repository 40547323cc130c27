"""Several processes as ``torchrun`` starts them, but forked; the store outlives each."""

import contextlib
import math
import os
import signal
import tempfile
import traceback
from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

import pytest
import torch
from cli.commands import run as run_command

from fragprune_plugins import Control, Fewer, Portable, Settings, joined
from fragprune_plugins.errors import FragpruneError
from fragprune_plugins.learning.stage2 import Stage2
from fragprune_plugins.workbench.finetune import loop
from fragprune_plugins.workbench.ranks import OLDEST

LONGEST = 60  # seconds that a child may live
STEPS = 12
CASES = {
    "all": Settings(iterations=STEPS, views_per_step=2),
    "target": Settings(iterations=STEPS, views_per_step=2, train="opacity", goal=Fewer(1.3)),
    "control": Settings(iterations=STEPS, views_per_step=2, goal=Control(), seed=3),
    "portable": Settings(iterations=STEPS, views_per_step=2, goal=Portable()),
    "two views each": Settings(iterations=STEPS, views_per_step=4, train="appearance"),
}


@dataclass(frozen=True)
class Ended:
    """How a process ended: its exit code, minus a signal's number, and what it left behind."""

    code: int
    left: Any


def _forked(work: Callable[[], None], seconds: int = LONGEST) -> int:
    pid = os.fork()
    if pid == 0:
        signal.signal(signal.SIGALRM, signal.SIG_DFL)
        signal.alarm(seconds)
        torch.set_num_threads(1)
        try:
            work()
        except BaseException:
            traceback.print_exc()
            os._exit(99)
        os._exit(0)
    return pid


def ended(work: Callable[[], Any]) -> int:
    """The exit code of a process in which a function was called: minus a signal's number."""

    def quietly() -> None:
        with contextlib.suppress(BaseException):
            work()

    return os.waitstatus_to_exitcode(os.waitpid(_forked(quietly, seconds=0), 0)[1])


def _keep_store(pipe: int) -> None:
    from torch.distributed import TCPStore

    store = TCPStore("localhost", 0, is_master=True, wait_for_workers=False)
    os.write(pipe, str(store.port).encode())
    signal.pause()


needs_processes = pytest.mark.skipif(
    torch.__version__ < OLDEST, reason=f"several processes need torch {OLDEST}"
)


def launch(size: int, work: Callable[[int], Any]) -> list[Ended]:
    """Call ``work(rank)`` in each of so many processes; what it returns is what that one left."""
    if torch.__version__ < OLDEST:
        pytest.skip(f"several processes need torch {OLDEST}")
    read, write = os.pipe()
    agent = _forked(lambda: _keep_store(write))
    given = {"WORLD_SIZE": str(size), "MASTER_ADDR": "localhost", "MASTER_PORT": ""}
    given |= {"TORCHELASTIC_USE_AGENT_STORE": "True", "TORCHELASTIC_RESTART_COUNT": "0"}
    try:
        given["MASTER_PORT"] = os.read(read, 16).decode()
        with tempfile.TemporaryDirectory() as folder:
            files = [Path(folder) / str(rank) for rank in range(size)]

            def one(rank: int) -> None:
                os.environ |= given | {"RANK": str(rank), "LOCAL_RANK": str(rank)}
                torch.save(work(rank), files[rank])

            children = [_forked(partial(one, rank)) for rank in range(size)]
            codes = [os.waitstatus_to_exitcode(os.waitpid(pid, 0)[1]) for pid in children]
            lefts = [torch.load(f, weights_only=False) if f.exists() else None for f in files]
            return [Ended(code, left) for code, left in zip(codes, lefts, strict=True)]
    finally:
        os.close(read)
        os.close(write)
        os.kill(agent, signal.SIGKILL)
        os.waitpid(agent, 0)


@dataclass(frozen=True)
class Raised:
    """A stated error, by its code and its words."""

    code: str
    text: str


def learn(size: int, work: Callable[[Any], Any]) -> list[Any]:
    """What ``work(ranks)`` returned, or the stated error, in each of so many processes."""

    def one(rank: int) -> Any:
        with joined(torch.device("cpu")) as ranks:
            try:
                return work(ranks)
            except FragpruneError as error:
                return Raised(error.code, str(error))

    ended = launch(size, one)
    assert [each.code for each in ended] == [0] * size
    return [each.left for each in ended]


def at_step(number: int, do: Callable[[], object]) -> None:
    """Do something when this process is in the midst of a step."""
    begin = Stage2.begin

    def beginning(stage: Any, opacities: Any) -> Any:
        if stage.steps == number:
            do()
        return begin(stage, opacities)

    Stage2.begin = beginning  # type: ignore[method-assign]


def lose_nan(ranks: Any) -> None:
    """Let the loss be NaN in the second process."""
    real = loop.photometric_loss

    def loss(image: torch.Tensor, target: torch.Tensor) -> torch.Tensor:
        return real(image, target) * (math.nan if ranks.rank == 1 else 1.0)

    loop.photometric_loss = loss  # type: ignore[assignment]


def command(size, *words, prepare=lambda _: None):
    """The command line in each process after ``prepare(rank)``: exit code, stdout and stderr."""

    def one(rank: int) -> Any:
        signal.signal(signal.SIGINT, signal.default_int_handler)
        prepare(rank)
        result = run_command(*words)
        return result.exit_code, result.stdout, result.stderr

    return launch(size, one)
