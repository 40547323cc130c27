"""The emulation of a GPU with kernels of the tests' own, or with somebody who tampers with it."""

import ctypes
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path

import torch

from fragprune_plugins.workbench.doctor.emulated import EmulatedDevice

HERE = Path(__file__).parent


class BrokenDevice(EmulatedDevice):
    """Takes its kernels from broken.cu."""

    def source(self, name: str) -> Path:
        """The file of all of them."""
        return HERE / "broken.cu"


class Numbers(ctypes.Structure):
    """What the kernels of broken.cu take."""

    _fields_ = (("to", ctypes.c_void_p),)


@dataclass(eq=False)  # a device is one by itself
class Watched:
    """The emulation; after each launch, ``after`` gets the kernel's name and arguments."""

    device: EmulatedDevice
    after: Callable[[str, ctypes.Structure], None]
    kind = "cpu"

    def launch(self, where, source, macros, kernel, blocks, arguments) -> None:
        self.device.launch(where, source, macros, kernel, blocks, arguments)
        self.after(kernel, arguments)


@contextmanager
def double_by_default() -> Iterator[None]:
    """As a host may have it, for numbers of its own."""
    torch.set_default_dtype(torch.float64)
    try:
        yield
    finally:
        torch.set_default_dtype(torch.float32)
