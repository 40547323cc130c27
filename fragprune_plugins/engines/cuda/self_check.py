"""Decides whether the cuda engine may be used on a GPU, by comparing it with other engines.

It compares in a process of its own: an invalid read breaks the GPU for its whole process, and a
kernel may wait forever. The verdict is stored beside the compiled kernels.
"""

from __future__ import annotations

import hashlib
import json
import subprocess
import sys
from contextlib import suppress
from dataclasses import asdict, dataclass
from functools import cache
from pathlib import Path
from typing import Final, Literal

import torch

from fragprune_plugins.engines.cuda import driver, kernels
from fragprune_plugins.errors import log

PATIENCE: Final = 300  # seconds that a check may take; mostly for compiling, once
BEGUN: Final = "begun"  # there is a context and memory: from here on faults are the kernels'
FAILS, COULD_NOT_RUN = 3, 4  # exit codes of the check's process, ``engines.cuda.comparison``

_OWN = b"".join(path.read_bytes() for path in sorted(Path(__file__).parent.glob("*.py")))
"""What calls the kernels and compares them: once it is mended, the check is made anew."""


@dataclass(frozen=True)
class Verdict:
    """The result of a check."""

    # "fails" for another picture, a crash, no end; "could not run" for no room, time or kernels
    outcome: Literal["agrees", "fails", "could not run"]
    reason: str = ""

    def __str__(self) -> str:
        if self.outcome == "fails":
            return f"the cuda engine fails on this GPU: {self.reason}"
        if self.outcome == "could not run":
            return f"the cuda engine could not be checked on this GPU: {self.reason}"
        return "the cuda engine draws what it should on this GPU"

    @property
    def remedy(self) -> str:
        """The next thing to do."""
        if self.outcome == "fails":
            return "Please report it, with fragprune doctor --json."
        return (
            "Free some of the GPU's memory; where its compute mode is exclusive, run fragprune "
            "doctor once while nothing else uses it. --engine cuda skips the check."
        )


def why_not(device: torch.device | str) -> Verdict | None:
    """The reason not to draw with the cuda engine on a GPU; None if it passed the check there."""
    where = torch.device(device)
    if where.index is None:  # the check's process has a current device of its own
        where = torch.device(where.type, torch.cuda.current_device())
    verdict = _remembered(where) or _checked(str(where))
    return None if verdict.outcome == "agrees" else verdict


@cache
def _checked(device: str) -> Verdict:
    """Check a GPU, at most once in this process."""
    log.info("checking the cuda engine on %s, once on this machine", device)
    return check_in_subprocess(device)


def check_in_subprocess(device: torch.device | str) -> Verdict:
    """Compare in another process and store the verdict, unless the check could not run."""
    verdict = _run(device)
    if verdict.outcome != "could not run":
        with suppress(OSError):  # read-only: the next process checks again
            marker = _marker(device)
            marker.parent.mkdir(parents=True, exist_ok=True)
            marker.write_text(json.dumps(asdict(verdict)))
    return verdict


def _run(device: torch.device | str) -> Verdict:
    command = [sys.executable, "-m", "fragprune_plugins.engines.cuda.comparison", str(device)]
    try:
        done = subprocess.run(command, capture_output=True, text=True, timeout=PATIENCE)
    except subprocess.TimeoutExpired as late:
        begun = BEGUN in str(late.stdout)
        return Verdict("fails" if begun else "could not run", f"no end within {PATIENCE} s")
    if done.returncode == 0:
        return Verdict("agrees")
    if done.returncode in (FAILS, COULD_NOT_RUN):
        begun, reason = done.returncode == FAILS, done.stderr.strip().splitlines()[-1]
    else:
        begun, reason = BEGUN in done.stdout, f"it ended with exit code {done.returncode}"
    return Verdict("fails" if begun else "could not run", reason)


def _remembered(device: torch.device | str) -> Verdict | None:
    try:
        return Verdict(**json.loads(_marker(device).read_text()))
    except (OSError, ValueError, TypeError):
        return None


def _marker(device: torch.device | str) -> Path:
    return kernels.cache_folder() / f"self-check-{_circumstances(str(device))}.json"


@cache
def _circumstances(device: str) -> str:
    """Everything that a verdict depends on; GPUs of one kind share a verdict."""
    compiler = kernels.compiler()
    gpu = torch.cuda.get_device_properties(device)
    what = (
        *(compiler.name, compiler.version, torch.__version__, torch.version.cuda),
        *(driver.version(), gpu.name, gpu.major, gpu.minor, gpu.multi_processor_count),
    )
    digest = hashlib.sha256(kernels.digest_of_sources() + _OWN + repr(what).encode())
    return digest.hexdigest()[:24]
