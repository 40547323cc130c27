"""Runs a function in a fresh process, without an imported host or an active session.

A server imports torch and the plugins once and forks for every call, which costs milliseconds.
"""

from __future__ import annotations

import contextlib
import gc
import importlib.util
import io
import multiprocessing
import pickle
import sys
import traceback
from collections.abc import Callable, Sequence
from importlib.metadata import entry_points
from multiprocessing.connection import Connection
from types import ModuleType
from typing import Any

from fragprune_plugins.plugins.loading import GROUP

_PRELOAD = ["torch._dynamo", "scipy.spatial", "plyfile", "PIL.Image"]
_PRELOAD += ["fragprune_plugins.testing.invariants"]


class FreshProcessError(AssertionError):
    """A fresh process raised (the message has the traceback), died, or took too long."""


class NotApplicable(Exception):  # noqa: N818 - a result, not a fault
    """A check does not apply to this host; the message gives the reason."""


def fresh(function: Callable[..., Any], *arguments: Any, seconds: float = 240.0) -> Any:
    """Call a function in a fresh process and return what it returns.

    Args:
        function: importable by its module's name, in the kit or installed.
        arguments: are pickled; their classes may come from files that only pytest imported.
        seconds: time limit of the process.

    Raises:
        NotApplicable: the function raised it.
        FreshProcessError: the function raised another error, or the process died or took longer.
    """
    context = multiprocessing.get_context("forkserver")
    plugins = [entry.module for entry in entry_points(group=GROUP)]
    context.set_forkserver_preload([*_PRELOAD, *plugins])
    ours, theirs = context.Pipe(duplex=False)
    task = pickle.dumps((function, arguments))
    process = context.Process(target=_serve, args=(theirs, _files_of((function, *arguments)), task))
    process.start()
    theirs.close()
    try:
        if not ours.poll(seconds):
            process.kill()
            raise FreshProcessError(f"took longer than {seconds:g} seconds")
        kind, value = ours.recv()
    except EOFError:
        process.join()
        raise FreshProcessError(f"the process died, exit code {process.exitcode}") from None
    finally:
        ours.close()
        if process.is_alive():
            process.join(5)
            process.kill()
    if kind == "skipped":
        raise NotApplicable(value)
    if kind == "failed":
        raise FreshProcessError(value)
    return value


def _files_of(values: Sequence[Any]) -> dict[str, str]:
    """The files of the modules that define functions, classes and objects, by module name."""
    inside = [
        part for value in values for part in (value, *getattr(value, "__dict__", {}).values())
    ]
    kinds = [each for part in inside for each in (part, *type(part).__mro__)]
    names = {str(getattr(each, "__module__", "")) for each in kinds} - {"__main__"}
    files = {name: getattr(sys.modules.get(name), "__file__", None) for name in names}
    return {name: file for name, file in files.items() if file}


def _serve(answer: Connection, files: dict[str, str], task: bytes) -> None:
    """Run the task in the fresh process; its output is shown only if it fails."""
    import torch

    torch.set_num_threads(1)  # the same sums in the same order
    gc.freeze()  # a run of a host ends in a full collection, which need not look at torch
    said = io.StringIO()
    try:
        with contextlib.redirect_stdout(said), contextlib.redirect_stderr(said):
            for name, file in files.items():
                _import(name, file)
            function, arguments = pickle.loads(task)
            answer.send(("done", function(*arguments)))
    except NotApplicable as reason:
        answer.send(("skipped", str(reason)))
    except BaseException as error:  # whatever it is, it is the result
        text = "".join(traceback.format_exception(error, chain=False))
        answer.send(("failed", f"{said.getvalue()[-2000:]}\n{text}"))


def _import(name: str, file: str) -> None:
    """Import a module by name, or from its file where its folder is not on the path."""
    try:
        importlib.import_module(name)
    except ModuleNotFoundError:
        spec = importlib.util.spec_from_file_location(name, file)
        assert spec is not None
        assert spec.loader is not None
        sys.modules[name] = module = importlib.util.module_from_spec(spec)
        spec.loader.exec_module(module)
        for end in (at for at, letter in enumerate(name) if letter == "."):  # pickle asks for them
            sys.modules.setdefault(name[:end], ModuleType(name[:end]))
