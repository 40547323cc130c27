"""Runs a host that hard-codes CUDA on a machine without a GPU (``--device cpu``).

Inside a block, a torch function mode rewrites CUDA devices, and substitutes replace CUDA calls.
Optimizers step in torch's fused kernel.
"""

from __future__ import annotations

import contextlib
import functools
import importlib
import re
import threading
import time
from collections.abc import Iterator
from types import SimpleNamespace
from typing import Any
from unittest import mock

import torch
from torch.overrides import TorchFunctionMode

from fragprune_plugins.learning.adam import stepping_fused

_CUDA = re.compile(r"cuda(:\d+)?$")
_NAMES = frozenset((str, torch.device))  # looked up by type: every torch call comes by
_NUMBERS = _NAMES | {int}  # where a number can only be a GPU's


def _redirected(value: Any) -> Any:
    """Replace "cuda", "cuda:N", N and CUDA's torch.device by the CPU; return others as given."""
    if type(value) is int or (isinstance(value, str) and _CUDA.match(value)):
        return "cpu"
    if isinstance(value, torch.device) and value.type == "cuda":
        return torch.device("cpu")
    return value


class _Redirect(TorchFunctionMode):
    """Replaces CUDA devices in every torch call inside; ``.cuda()`` returns its tensor."""

    def __torch_function__(
        self,
        func: Any,
        types: Any,
        args: tuple[Any, ...] = (),
        kwargs: dict[str, Any] | None = None,
    ) -> Any:
        kwargs = kwargs or {}
        if func is torch.Tensor.cuda or func is torch.Tensor.pin_memory:
            return args[0]
        if func is torch.Tensor.get_device:  # hosts pass it to .to(), which refuses -1
            return torch.device("cpu")
        number = func is torch.Tensor.to or (func is torch.device and len(args) == 1)
        names = _NUMBERS if number else _NAMES
        if not names.isdisjoint(map(type, args)):
            args = tuple(_redirected(a) if type(a) in names else a for a in args)
        if "device" in kwargs:
            kwargs["device"] = _redirected(kwargs["device"])
        kwargs.pop("pin_memory", None)
        return func(*args, **kwargs)


class _Generator(torch.Generator):
    def __new__(cls, device: Any = "cpu") -> _Generator:
        return super().__new__(cls, _redirected(device))  # type: ignore[call-arg]


def _nothing(*_: Any, **__: Any) -> int:
    """Replaces a CUDA call that has no meaning on the CPU: device 0, and no memory in use."""
    return 0


class _Event(contextlib.nullcontext[None]):
    """A CUDA event that reads the wall clock; also a stream or a device, which order nothing."""

    wait = wait_event = wait_stream = synchronize = _nothing  # work is done when a call returns

    def __init__(self, *_: Any, **__: Any) -> None:
        super().__init__()
        self._time = 0.0

    def record(self, *_: Any) -> None:
        """Store the current time."""
        self._time = time.perf_counter()

    def record_event(self, event: _Event | None = None) -> _Event:
        """An event of a stream."""
        return event or _Event()

    def query(self) -> bool:
        """Whether the work before the event is done: always."""
        return True

    def elapsed_time(self, end: _Event) -> float:
        """Milliseconds from this event to another."""
        return (end._time - self._time) * 1e3


_MEMORY = 8 << 30  # bytes, as of a small GPU: hosts choose by it how much they do at once
_GPU = SimpleNamespace(name="cpu", total_memory=_MEMORY, major=0, minor=0, multi_processor_count=1)

_SUBSTITUTES: dict[str, Any] = {
    **dict.fromkeys(("Event", "Stream", "stream", "current_stream", "default_stream"), _Event),
    "device": _Event,
    **dict.fromkeys(("set_device", "synchronize", "empty_cache", "current_device"), _nothing),
    **dict.fromkeys(("reset_peak_memory_stats", "reset_max_memory_allocated"), _nothing),
    **dict.fromkeys(("memory_allocated", "max_memory_allocated", "memory_reserved"), _nothing),
    "get_device_properties": lambda *_: _GPU,
    "mem_get_info": lambda *_: (_MEMORY, _MEMORY),
    "FloatTensor": torch.FloatTensor,
    "IntTensor": torch.IntTensor,
}


@contextlib.contextmanager
def cpu_only() -> Iterator[None]:
    """Inside, torch calls that name CUDA run on the CPU, and checkpoints load to the CPU."""
    # Optimizers import torch._dynamo, which would take our substitutes for torch's functions.
    importlib.import_module("torch._dynamo")
    load, run, parse = torch.load, threading.Thread.run, torch._C._nn._parse_to

    @functools.wraps(load)
    def load_to_cpu(f: Any, map_location: Any = None, *args: Any, **kwargs: Any) -> Any:
        return load(f, _redirected(map_location or "cpu"), *args, **kwargs)

    def parse_redirected(*args: Any, **kwargs: Any) -> Any:  # of nn.Module.to
        return parse(*map(_redirected, args), **{k: _redirected(v) for k, v in kwargs.items()})

    def run_redirected(thread: threading.Thread) -> None:  # a mode is its thread's own
        with _Redirect():
            run(thread)

    with (
        mock.patch.multiple(torch.cuda, **_SUBSTITUTES),
        mock.patch.multiple(torch, load=load_to_cpu, Generator=_Generator),
        mock.patch.object(torch._C._nn, "_parse_to", parse_redirected),
        mock.patch.object(threading.Thread, "run", run_redirected),
        stepping_fused(),
        _Redirect(),
    ):
        yield
