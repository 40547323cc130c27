"""The emulation of a GPU with kernels of the tests' own."""

import ctypes
from pathlib import Path

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
