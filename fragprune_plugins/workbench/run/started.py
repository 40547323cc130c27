"""What a sweep finds in place of ``python``: a host's script as by ``fragprune run``, else Python.

``python -m fragprune_plugins.workbench.run.started FOLDER [what the interpreter is told]``
"""

from __future__ import annotations

import json
import os
import sys
import time
from pathlib import Path
from typing import Any

from filelock import FileLock

from fragprune_plugins.errors import FragpruneError, UnknownHostError, UsageError, log
from fragprune_plugins.hosts.choosing import locate
from fragprune_plugins.hosts.source import HostRepo
from fragprune_plugins.injection.command import split
from fragprune_plugins.plugins.loading import installed
from fragprune_plugins.workbench.run import command
from fragprune_plugins.workbench.run.sweep import OPTIONS, STOPPED, is_sweep
from fragprune_plugins.workbench.run.unserved import unserved


def main(folder: Path, words: list[str]) -> None:
    """Run what the interpreter is told, and leave what became of it in the folder if it is served.

    Args:
        folder: of the sweep; its options lie there.
    """
    if not _is_served(words):
        os.execv(sys.executable, [sys.executable, *words])
    options = json.loads((folder / OPTIONS).read_text())
    began, reports, code = time.time_ns(), list[Any](), 1
    with FileLock(folder / f"{began}-{os.getpid()}.lock"):
        if (folder / STOPPED).exists():
            sys.exit(130)
        try:
            command.main([*options, "--", "python", *words], prog_name="fragprune run", obj=reports)
        except SystemExit as end:
            code = int(end.code or 0)
            raise
        finally:
            data = reports[0].data if reports else None
            done = {"command": words, "exit_code": code, "report": data}
            (folder / f"run-{began}.json").write_text(json.dumps(done))


def _is_served(words: list[str]) -> bool:
    """Whether ``fragprune run`` serves a script: a host's, or one that starts such."""
    try:
        script, _, _ = split(["python", *words])
        if is_sweep(words):
            return True
        locate(HostRepo(script.parent), installed().adapters)
    except UsageError:  # no script: -c, or a module of the standard library
        return False
    except UnknownHostError as error:
        if unserved(["python", *words]):
            return True
        if "train" in script.stem:
            log.warning("%s runs as it is, unpruned: %s", script.name, error)
        return False
    except FragpruneError:  # it is a host's; the error is stated where it runs
        return True
    return True


if __name__ == "__main__":
    main(Path(sys.argv[1]), sys.argv[2:])
