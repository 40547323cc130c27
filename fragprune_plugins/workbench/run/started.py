"""What a sweep finds in place of ``python``: a host's script as by ``fragprune run``, else Python.

``python -m fragprune_plugins.workbench.run.started FOLDER [what the interpreter is told]``
"""

from __future__ import annotations

import json
import logging
import os
import signal
import sys
import time
from logging.handlers import MemoryHandler
from pathlib import Path
from typing import Any

from fragprune_plugins.errors import FragpruneError, UnknownHostError, UsageError, log
from fragprune_plugins.files.atomic import replacing
from fragprune_plugins.hosts import choosing, source
from fragprune_plugins.injection.command import split
from fragprune_plugins.plugins.loading import installed
from fragprune_plugins.workbench.figures.records import strict
from fragprune_plugins.workbench.run import command, recognising, sweep
from fragprune_plugins.workbench.run.unserved import unserved


def main(folder: Path, words: list[str]) -> None:
    """Run what the interpreter is told, and leave what became of it in the sweep's folder."""
    logging.basicConfig(level=logging.INFO, format="fragprune: %(message)s", stream=sys.stderr)
    warned = MemoryHandler(1000, logging.CRITICAL)  # stderr may go anywhere
    warned.setLevel(logging.WARNING)
    log.addHandler(warned)
    result = folder / f"run-{time.time_ns()}-{os.getpid()}.json"
    done = {"command": words, "pid": None, "exit_code": 0, "report": None}
    if not _is_served(words):
        if warned.buffer:
            _write(result, done, warned)
        os.execv(sys.executable, [sys.executable, *words])
    paths = (Path(word) for word in words)
    if ours := [path for path in paths if ".fragprune." in path.name and path.is_file()]:
        log.info("%s lies beside a model, and is none: left out", ours[0])  # of a glob
        return
    signal.signal(signal.SIGINT, signal.default_int_handler)  # a shell's & has it ignored
    signal.signal(signal.SIGHUP, signal.SIG_IGN)  # it ends the shells around, not what saves
    options, reports = json.loads((folder / sweep.OPTIONS).read_text()), list[Any]()
    done |= {"pid": os.getpid(), "exit_code": None}
    _write(result, done, warned)
    if (folder / sweep.STOPPED).exists():
        sys.exit(130)
    done["exit_code"] = 1
    try:
        command.main([*options, "--", "python", *words], prog_name="fragprune run", obj=reports)
    except SystemExit as end:
        done["exit_code"] = int(end.code or 0)
        raise
    finally:
        done["report"] = reports[0].data if reports else None
        _write(result, done, warned)


def _write(path: Path, done: dict[str, Any], warned: MemoryHandler) -> None:
    said = list(dict.fromkeys(each.getMessage() for each in warned.buffer))
    with replacing(path) as whole:
        whole.write_text(json.dumps(strict(done | {"warnings": said})))


def _is_served(words: list[str]) -> bool:
    """Whether ``fragprune run`` serves a script: a host's, or one that starts such."""
    try:
        script, _, _ = split(["python", *words], quietly=True)
        if not recognising.is_sweep(["python", *words]):
            choosing.locate(source.HostRepo(script.parent), installed().adapters)
    except UsageError:  # no script: -c, or a module of the standard library
        return False
    except UnknownHostError as error:
        served = unserved(["python", *words]) is not None
        if not served and "train" in script.stem:
            log.warning("%s runs as it is, unpruned: %s", script.name, error)
        return served
    except FragpruneError:  # it is a host's; the error is stated where it runs
        pass
    return True


if __name__ == "__main__":
    os.set_inheritable(sweep.HELD, False)
    main(Path(sys.argv[1]), sys.argv[2:])
