"""Sets up this process for a host's script, and restores it when the script ends."""

from __future__ import annotations

import contextlib
import os
import runpy
import sys
import traceback
from collections.abc import Iterator
from pathlib import Path
from typing import Any, NoReturn
from unittest import mock

import numpy as np
import torch
from PIL import Image

from fragprune_plugins.engines import device_for
from fragprune_plugins.engines.cpu.memory import keep_freed_memory
from fragprune_plugins.errors import FragpruneError, HostFailed
from fragprune_plugins.hosts import preflight
from fragprune_plugins.hosts.source import HostRepo
from fragprune_plugins.injection.cpu_only import cpu_only

READ = "Read the host's own message above."

_OURS = Path(__file__).parents[1]
_REDIRECTING = str(Path(__file__).with_name("cpu_only.py"))


@contextlib.contextmanager
def telling(script: Path, root: Path) -> Iterator[None]:
    """Turn an exception of the host into a ``HostFailed``; stderr gets the whole traceback."""
    try:
        yield
    except FragpruneError:
        raise
    except Exception as error:
        traceback.print_exc()
        every = traceback.extract_tb(error.__traceback__)
        # On a CPU each call of torch passes through ours, whoever made it.
        frames = [frame for frame in every if frame.filename != _REDIRECTING]
        inside = [frame for frame in frames if Path(frame.filename).is_relative_to(root)]
        where = script.name
        if inside:
            file = Path(inside[-1].filename).relative_to(root)
            where = f"{file}:{inside[-1].lineno} in {inside[-1].name}"
        message = "".join(str(error).strip().splitlines()[:1])
        expected, remedy = f"{script.name} to run to its end", "Read the traceback above."
        lacking = (error.name or "").split(".")[0] if isinstance(error, ImportError) else ""
        if isinstance(error, torch.cuda.OutOfMemoryError):
            remedy = "Free memory of the GPU, or need less (3DGS: -r 2, or --data_device cpu)."
        elif Path(frames[-1].filename).is_relative_to(_OURS):
            remedy = "fragprune raised it. Report it with the traceback above."
        elif isinstance(error, ModuleNotFoundError) and not HostRepo(root).path(lacking):
            expected = "what the host itself imports"
            remedy = preflight.install([preflight.Missing(lacking, where)])
        found = f"{type(error).__name__}{f': {message}' if message else ''}"
        raise HostFailed(where, found, expected, remedy) from error


@contextlib.contextmanager
def host_process(script: Path, arguments: list[str], device: str, folder: Path) -> Iterator[None]:
    """Inside, ``sys.argv``, ``sys.path`` (first ``folder``) and devices are set for the script."""
    saved = sys.argv, sys.path[:], sys.stdout, sys.stderr
    sys.argv = [str(script), *arguments]
    sys.path.insert(0, str(folder))
    try:
        with surroundings(device):
            yield
    finally:
        sys.argv, sys.path[:], sys.stdout, sys.stderr = saved


@contextlib.contextmanager
def surroundings(device: str) -> Iterator[None]:
    """Inside, torch and Pillow do what hosts expect of them on this device."""
    with (
        knowing_numpy(),
        _host_pictures(),
        mock.patch.object(os, "execv", _refuse_to_start_again),
        cpu_only() if device == "cpu" else current_gpu(device),
    ):
        if device == "cpu":
            keep_freed_memory(growing=True)
        yield


def run_main(script: Path, module: str) -> None:
    """Run a script, or ``python -m module``, as ``__main__``, to its end or ``sys.exit(0)``.

    Raises:
        HostFailed: it ended with another exit code.
        FragpruneError: it did so because of this error of ours.
    """
    try:
        if module:
            runpy.run_module(module, run_name="__main__", alter_sys=True)
        else:
            runpy.run_path(str(script), run_name="__main__")
    except SystemExit as error:
        if isinstance(error.__cause__, FragpruneError):
            raise error.__cause__ from None
        if error.code not in (None, 0):
            found = f"ended with exit code {error.code}"
            raise HostFailed(script.name, found, "exit code 0", READ) from error


_ENVIRONMENT = {"site-packages", "dist-packages"}


def forget_modules(root: Path, known: set[str], packages: tuple[str, ...] = ()) -> None:
    """Drop the host's own modules, so that its script can run again from the start.

    Args:
        root: the host's folder; packages of an environment that is this folder, or in it, are kept.
        known: names of modules that were imported before the host ran.
        packages: import names of an installed host; its compiled modules are kept.
    """
    for name in sys.modules.keys() - known:
        file = getattr(sys.modules[name], "__file__", None) or ""
        own = not file or file.endswith(".py")
        if name.split(".")[0] not in packages:
            parts = Path(file).parts[len(root.parent.parts) :]
            own = Path(file).is_relative_to(root) and _ENVIRONMENT.isdisjoint(parts)
        if own:
            del sys.modules[name]


def host_device(wanted: str, engine: str) -> str:
    """The host's device, "cpu", "cuda" or "cuda:N"; "auto" takes a GPU if torch sees one."""
    if wanted == "auto" and torch.cuda.is_available():
        return "cuda"
    return str(device_for(wanted, engine))


@contextlib.contextmanager
def current_gpu(device: str) -> Iterator[None]:
    """Inside, "cuda" means the GPU of ``device`` ("cuda:N"), and a host cannot choose another."""
    if not device.startswith("cuda:"):
        yield
        return
    with torch.cuda.device(device), mock.patch.object(torch.cuda, "set_device"):
        yield


def knowing_numpy() -> contextlib.AbstractContextManager[None]:
    """Inside, torch's safe loader takes NumPy's numbers; before torch 2.5 it cannot be told to."""
    telling = getattr(torch.serialization, "safe_globals", None)
    return telling(checkpoint_values()) if telling else contextlib.nullcontext()


def checkpoint_values() -> list[Any]:
    """What torch's safe loader does not know of what hosts save: NumPy's scalars and arrays."""
    made: list[Any] = [each.__reduce__()[0] for each in (np.float64(0), np.zeros(0))]
    kinds = (type(np.dtype(kind)) for kind in ("f4", "f8", "i4", "i8", "u1", "?"))
    return [*made, np.ndarray, np.dtype, *kinds]


def _refuse_to_start_again(program: str, arguments: list[str]) -> NoReturn:
    """In place of ``os.execv``: a host that starts itself again would run without fragprune."""
    found = "an attempt to start itself again, as some hosts do where their loss is NaN"
    raise HostFailed(Path(sys.argv[0]).name, found, "a run that reaches its end", READ)


@contextlib.contextmanager
def _host_pictures() -> Iterator[None]:
    """Inside, Pillow takes int8 arrays, as it once did: hosts with Blender scenes pass them."""
    fromarray = Image.fromarray

    def from_bytes(array: Any, mode: str | None = None) -> Any:
        signed = isinstance(array, np.ndarray) and array.dtype == np.int8
        return fromarray(array.view(np.uint8) if signed else array, mode)

    with mock.patch.object(Image, "fromarray", from_bytes):
        yield
