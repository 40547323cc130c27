"""A GPU that is pretended: tensors say that they lie on one, and torch's rules of devices hold.

Their numbers are on the CPU, and the cuda engine's kernels run in the emulation. A call that mixes
devices fails as it would on a GPU, in forward and in backward. ``main`` is the command
``fragprune`` on a machine with such a GPU. The first word of ``sys.argv`` is a folder to build in.
"""

import ctypes
import os
import subprocess
import sys
from collections.abc import Iterator
from contextlib import contextmanager, nullcontext
from importlib.util import find_spec
from pathlib import Path
from types import SimpleNamespace
from typing import Any
from unittest import mock

BUILDS = Path(sys.argv[1])  # of the emulation, and of what torch's own code asks of a GPU
ROOT = Path(find_spec("torch").origin).parent
if not (BUILT := BUILDS / "pretended.so").exists():
    flags = ["-std=c++20", "-w", "-shared", "-fPIC", f"-I{ROOT}/include", f"-L{ROOT}/lib"]
    mine = BUILT.with_name(f"{os.getpid()}-{BUILT.name}")  # others may be at the same
    flags += [f"-Wl,-rpath,{ROOT}/lib", "-lc10", "-ltorch_cpu", "-o", str(mine)]
    subprocess.run(["g++", str(Path(__file__).with_suffix(".cpp")), *flags], check=True)
    mine.replace(BUILT)
ctypes.CDLL(str(BUILT))  # before torch, which looks once

import torch  # noqa: E402
import torch._dynamo  # noqa: E402  # would take what stands in for torch's functions
from torch.utils._python_dispatch import TorchDispatchMode  # noqa: E402
from torch.utils._pytree import tree_flatten, tree_map  # noqa: E402

aten = torch.ops.aten
MOVING = (aten.copy_.default, aten._to_copy.default)
INDEXING = (aten.index.Tensor, aten.index_put_.default, aten._index_put_impl_.default)


class Pretended(torch.Tensor):
    """Its numbers are those of the tensor ``held``, on the CPU."""

    __torch_function__ = torch._C._disabled_torch_function_impl

    @staticmethod
    def __new__(cls, held: torch.Tensor) -> "Pretended":
        shape = {"strides": held.stride(), "storage_offset": held.storage_offset()}
        made = torch.Tensor._make_wrapper_subclass(
            cls, held.shape, dtype=held.dtype, device=torch.device("cuda:0"), **shape
        )
        made.held = held
        return made

    @classmethod
    def __torch_dispatch__(cls, func, types, args=(), kwargs=None):
        return call(func, args, kwargs or {})

    def data_ptr(self) -> int:
        return self.held.data_ptr()

    def tolist(self) -> Any:
        return self.detach().cpu().tolist()

    def numpy(self, *_: Any, **__: Any) -> Any:
        raise TypeError("can't convert cuda:0 device type tensor to numpy")

    __array__ = numpy

    def __reduce_ex__(self, protocol: int) -> Any:
        return restored, (self.held, getattr(self, "_is_param", False), self.requires_grad)


def restored(held: torch.Tensor, parameter: bool, learns: bool) -> torch.Tensor:
    """A tensor of a file that was saved here, where ``torch.load`` wants it."""
    made = Pretended(held) if loads_to in (None, "cuda", torch.device("cuda")) else held
    return torch.nn.Parameter(made, learns) if parameter else made.requires_grad_(learns)


loads_to = None


def load(file: Any, map_location: Any = None, **options: Any) -> Any:
    """``torch.load``, to the GPU unless told otherwise."""
    with mock.patch(f"{__name__}.loads_to", map_location):
        return own_load(file, "cpu", **options)


def on_gpu(device: Any) -> bool:
    return device is not None and torch.device(device).type == "cuda"


def expect_one_device(func: Any, args: tuple[Any, ...], tensors: list[torch.Tensor]) -> None:
    """Raise RuntimeError where a call has tensors on the GPU, and others where they must not be."""
    if func in MOVING or not any(isinstance(each, Pretended) for each in tensors):
        return
    free = ()  # numbers on the CPU go with any tensor, and its indices may be there
    if func in INDEXING and isinstance(args[0], Pretended):
        free = [id(each) for each in args[1]]
    for each in tensors:
        if not isinstance(each, Pretended) and each.dim() and id(each) not in free:
            raise RuntimeError(f"{func}: a tensor of {tuple(each.shape)} is on the CPU")
    if not isinstance(args[0], Pretended) and (func in INDEXING or func._schema.is_mutable):
        raise RuntimeError(f"{func}: a tensor on the GPU changes or chooses from one on the CPU")


def call(func: Any, args: tuple[Any, ...], kwargs: dict[str, Any]) -> Any:
    """An operation of torch on tensors of which some may be on the GPU."""
    tensors = [each for each in tree_flatten((args, kwargs))[0] if isinstance(each, torch.Tensor)]
    expect_one_device(func, args, tensors)
    device = kwargs.get("device")
    if device is not None:
        goes = on_gpu(device)
        kwargs = {**kwargs, "device": torch.device("cpu")}
    else:
        first = tensors[:1] if func in MOVING else tensors
        goes = any(isinstance(each, Pretended) for each in first)
    held = tree_map(lambda x: x.held if isinstance(x, Pretended) else x, (args, kwargs))
    out = func(*held[0], **held[1])
    if func._schema.is_mutable:  # what is changed in place is what is returned
        known = {id(x.held): x for x in tensors if isinstance(x, Pretended)}
        out = tree_map(lambda x: known.get(id(x), x), out)
    if not goes:
        return out

    def raised(value: Any) -> Any:
        plain = isinstance(value, torch.Tensor) and not isinstance(value, Pretended)
        return Pretended(value) if plain else value

    return tree_map(raised, out)


class Everywhere(TorchDispatchMode):
    """Makes new tensors on the GPU, too, which no tensor of it takes part in."""

    def __torch_dispatch__(self, func, types, args=(), kwargs=None):
        return call(func, args, kwargs or {})


def nothing(*_: Any) -> int:
    return 0


def address(value: Any) -> Any:
    """What a kernel gets, which reads no memory of the CPU."""
    if isinstance(value, torch.Tensor) and not isinstance(value, Pretended):
        raise RuntimeError(f"a kernel of the GPU gets a tensor of {tuple(value.shape)} on the CPU")
    return own_address(value)


class Generator:
    """``torch.Generator``, on the CPU wherever it is asked for."""

    def __new__(cls, *_: Any) -> Any:
        return own_generator()


class Emulated:
    """The device of the cuda engine: the emulation, for tensors that say "cuda"."""

    kind = "cuda"

    def __init__(self) -> None:
        from fragprune_plugins.workbench.doctor.emulated import EmulatedDevice

        self.launch = EmulatedDevice("g++", BUILDS).launch


own_address: Any = None
own_load, own_generator = torch.load, torch.Generator
GPU = {
    **dict.fromkeys(("_lazy_init", "init", "set_device", "synchronize", "empty_cache"), nothing),
    **dict.fromkeys(("current_device", "memory_allocated", "max_memory_allocated"), nothing),
    "reset_peak_memory_stats": nothing,
    "is_available": lambda: True,
    "device_count": lambda: 1,
    "device": nullcontext,
    "get_device_name": lambda *_: "pretended",
    "get_device_capability": lambda *_: (9, 0),
    "current_stream": lambda *_: SimpleNamespace(cuda_stream=0),
}


@contextmanager
def a_gpu() -> Iterator[None]:
    """Inside, torch has this GPU."""
    from fragprune_plugins.engines.cpu import binding
    from fragprune_plugins.engines.cuda import driver, engine, self_check
    from fragprune_plugins.injection.cpu_only import _Event as Event

    torch.serialization.add_safe_globals([restored])
    torch._C._set_only_lift_cpu_tensors(True)  # torch.tensor makes one on the CPU, and moves it
    with (
        mock.patch.multiple(torch.cuda, Event=Event, **GPU),
        mock.patch.object(torch.Tensor, "cuda", lambda self, *_, **__: self.to("cuda")),
        mock.patch.multiple(torch, load=load, Generator=Generator),
        mock.patch.multiple(__name__, own_address=binding.address),
        mock.patch.object(binding, "address", address),
        mock.patch.object(driver, "missing", return_value=None),
        mock.patch.object(self_check, "why_not", return_value=None),
        mock.patch.object(engine, "Driver", Emulated),
        mock.patch.object(engine.CudaEngine, "capacity", 1 << 13),
        Everywhere(),
    ):
        yield


@contextmanager
def leaving() -> Iterator[None]:
    """End the process at once if all went well: torch's thread of a device may outlive Python."""
    try:
        yield
    except SystemExit as end:
        if end.code:
            raise
    sys.stdout.flush()
    os._exit(0)


def main() -> None:
    """The command, on this GPU."""
    from fragprune_plugins.workbench.commands import main as fragprune

    sys.argv[:2] = ["fragprune"]
    with a_gpu():
        fragprune()
