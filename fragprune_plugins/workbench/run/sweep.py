"""A script that starts trainings, such as ``full_eval.py`` or ``train.sh``: each one is served.

It runs by itself, and finds a ``python`` in front of the real one: what a host's script is started
by runs it as if ``fragprune run`` stood there, with the same options (``started``).
"""

from __future__ import annotations

import contextlib
import json
import os
import shlex
import shutil
import signal
import stat
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Sequence
from functools import partial
from pathlib import Path
from typing import Any

from fragprune_plugins.errors import HostFailed, UsageError, log
from fragprune_plugins.learning.interruption import Terminate, sigterm_interrupts
from fragprune_plugins.workbench.commands.command import Report
from fragprune_plugins.workbench.figures import wording
from fragprune_plugins.workbench.run.recognising import SINGLY

OPTIONS = "options.json"
STOPPED, RUNNING = "stopped", "running"
HELD = 9  # what is started holds the pipe RUNNING open by this number, until it ends
_BEGINS = 0.5  # seconds; what a shell left behind with & may not hold the pipe yet
_SHIM = """#!/bin/sh
exec 9<>{pipe}
case "${{1:--}}" in -|-c|-V|--version) exec {python} "$@" 9>&- ;; esac
exec {ours} "$@"
"""
"""It tells some of what is no script of a host at no cost."""


def run_sweep(command: Sequence[str], options: Sequence[str], *, quietly: bool) -> Report:
    """Run such a script, with each of a host's that it starts as if ``fragprune run`` stood there.

    ``options`` are the words in front of the command; with ``quietly`` scripts print to stderr.
    """
    words, name = list(command), shlex.join(command)
    if os.name != "posix":
        raise UsageError(name, os.name, "Linux or macOS, for a script of trainings", SINGLY)
    if words[0].endswith((".py", ".sh")):
        words.insert(0, "python" if words[0].endswith(".py") else shutil.which("bash") or "sh")
    if Path(words[0]).name.startswith("python"):
        words[0] = sys.executable  # not the one in front of it
    with tempfile.TemporaryDirectory(prefix="fragprune-") as scratch:
        folder = Path(scratch)
        path = os.pathsep.join([str(_shims(folder, options)), os.environ.get("PATH", os.defpath)])
        log.info("%s: each script of a host that it starts runs as by fragprune run", name)
        code = _ran(words, folder, os.environ | {"PATH": path}, quietly=quietly)
        runs = _runs(folder)
    served = [each for each in runs if each["pid"]]
    failed = [each for each in served if each["exit_code"] != 0]
    if not served:
        found = "it started no script of a host by the word python"
        raise HostFailed(name, found, "trainings that fragprune can serve", SINGLY)
    lines = [_line(each) for each in runs]
    lines.append(f"{len(served) - len(failed)} of {len(served)} commands of a host ended well.")
    if code:
        lines.append(f"{name}: ended with exit code {code}.")
    return Report({"runs": runs, "exit_code": code}, "\n".join(lines), code or int(bool(failed)))


def _shims(folder: Path, options: Sequence[str]) -> Path:
    """Write what is found in place of ``python``; returns its folder."""
    kept = [_anywhere(each) for each in options if each not in ("--", "--json")]
    (folder / OPTIONS).write_text(json.dumps(kept))
    shims = folder / "bin"
    shims.mkdir()
    words = [sys.executable, "-m", "fragprune_plugins.workbench.run.started", str(folder)]
    pipe, python = (shlex.quote(str(each)) for each in (folder / RUNNING, sys.executable))
    text = _SHIM.format(pipe=pipe, python=python, ours=shlex.join(words))
    major, minor = sys.version_info[:2]
    for name in ("python", f"python{major}", f"python{major}.{minor}"):
        (shims / name).write_text(text)
        (shims / name).chmod(stat.S_IRWXU)
    if not os.access(shims / "python", os.X_OK):
        found = "a folder in which nothing can be executed"
        raise UsageError(str(shims), found, "one in which a script can", "Set TMPDIR to another.")
    return shims


def _anywhere(word: str) -> str:
    """A word that names a file, such as that of --config, so that it does in every folder."""
    option, equals, value = word.rpartition("=")
    return f"{option}{equals}{Path(value).resolve()}" if Path(value).is_file() else word


def _ran(words: list[str], folder: Path, environment: dict[str, str], *, quietly: bool) -> int:
    """The exit code of the script, once all that it started has ended.

    A signal ends the script first, and is then heard by what is served. SIGHUP ends the shells
    inside, also under nohup, which has all that it starts ignore it; no terminal sends it there.
    """
    os.mkfifo(folder / RUNNING)
    running = os.open(folder / RUNNING, os.O_RDONLY | os.O_NONBLOCK)
    with (
        sigterm_interrupts(),
        subprocess.Popen(
            words,
            env=environment,
            stdout=2 if quietly else None,
            start_new_session=True,
            preexec_fn=partial(signal.signal, signal.SIGHUP, signal.SIG_DFL),
        ) as script,
    ):
        try:
            code = script.wait()
            time.sleep(_BEGINS)
            _wait(running)
        except KeyboardInterrupt as interrupt:
            (folder / STOPPED).touch()
            script.kill()  # a shell would go on with its next line
            _send(os.killpg, script.pid, signal.SIGHUP)  # so would those inside
            if isinstance(interrupt, Terminate):  # their workers end with them
                for run in (each for each in _runs(folder) if each["exit_code"] is None):
                    _send(os.kill, run["pid"], signal.SIGTERM)
            else:
                _send(os.killpg, script.pid, signal.SIGINT)
            try:
                _wait(running)  # they save what they have learned
            finally:
                _send(os.killpg, script.pid, signal.SIGKILL)
            raise
    return code if code >= 0 else 128 - code


def _wait(running: int) -> None:
    """Wait until nothing holds the pipe."""
    os.set_blocking(running, True)
    os.read(running, 1)


def _send(by: Callable[[int, int], None], pid: int, number: int) -> None:
    with contextlib.suppress(ProcessLookupError):
        by(pid, number)


def _runs(folder: Path) -> list[dict[str, Any]]:
    """What was served, in the order in which it began."""
    return [json.loads(each.read_text()) for each in sorted(folder.glob("run-*.json"))]


def _line(run: dict[str, Any]) -> str:
    """What became of a script that was served."""
    data: dict[str, Any] = run["report"] or {}
    said = [f"python {shlex.join(run['command'])}"]
    if run["exit_code"] != 0:
        code = run["exit_code"]
        said.append("was killed" if code is None else f"ended with exit code {code}")
    elif data.get("before"):
        gained = f"{wording.gain(data['before'], data['after'])}."
        control = data["control"]
        said.append(wording.outcome("run", data, control) if control else gained)
    said += [data["model_after"]] if data.get("model_after") else []
    if data.get("adapter", "") is None:  # its render.py is not served
        said.append(f"The codebase itself draws {data['model_before']}, which is not pruned.")
    said += [_line(each) for each in data.get("runs", ())]
    said += run["warnings"]
    return "\n".join(said).replace("\n", "\n  ")
