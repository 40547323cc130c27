"""A device that runs the kernels' own sources on the CPU, thread by thread, in shuffled order."""

import ctypes
import hashlib
import os
import subprocess
from pathlib import Path

import torch

import fragprune_plugins.native

HERE = Path(__file__).parent
SOURCES = Path(fragprune_plugins.native.__file__).parent / "cuda"
FLAGS = (
    "-std=c++17",
    "-O1",
    "-w",
    "-ffp-contract=off",
    "-fno-math-errno",
    "-fPIC",
    "-shared",
    "-fvisibility=hidden",
)


class EmulatedDevice:
    """Builds a source once per set of macros, for all processes that share the folder.

    Args:
        compiler: a C++17 compiler for ELF systems.
        folder: where builds go.
        flags: further ones of the compiler.

    Attributes:
        launched: kernels with their macros, in order.
        opened: what was built, by source and macros.
        seed: of the order in which threads and blocks run.
        resident: blocks that run at a time, 1 to 3.
    """

    def __init__(self, compiler: str, folder: Path, flags: tuple[str, ...] = ()) -> None:
        self.compiler, self._folder, self._flags = compiler, folder, flags
        self.seed, self.resident = 1, 3
        self.launched: list[tuple[str, dict[str, int]]] = []
        self.opened: dict[tuple[str, tuple[tuple[str, int], ...]], ctypes.CDLL] = {}

    kind = "cpu"

    def launch(
        self,
        where: torch.device,
        source: str,
        macros: dict[str, int],
        kernel: str,
        blocks: int,
        arguments: ctypes.Structure,
    ) -> None:
        self.launched.append((kernel, macros))
        library = self._open(source, macros)
        status = library.emulated_launch(
            kernel.encode(), blocks, 256, ctypes.byref(arguments), self.seed, self.resident
        )
        if status:
            raise RuntimeError(library.emulated_message().decode())

    def _open(self, source: str, macros: dict[str, int]) -> ctypes.CDLL:
        key = (source, tuple(sorted(macros.items())))
        if key not in self.opened:
            name = hashlib.sha256(repr(key).encode()).hexdigest()[:16]
            path = self._folder / f"{source}-{name}.so"
            defined = [f"-D{name}={value}" for name, value in macros.items()]
            kernels = ("-x", "c++", "-include", str(HERE / "emulation.h"), self.source(source))
            if not path.exists():
                self._compile(path, *self._flags, *defined, *kernels)
            library = ctypes.CDLL(str(path))
            library.emulated_message.restype = ctypes.c_char_p
            self.opened[key] = library
        return self.opened[key]

    def source(self, name: str) -> str:
        """The file of a source."""
        return str(SOURCES / f"{name}.cu")

    def _compile(self, path: Path, *kernels: str) -> None:
        self._build(path, "-shared", self._part("emulation"), *kernels)

    def _part(self, name: str) -> str:
        """A source of the emulation itself, compiled once."""
        path = self._folder / f"{name}.o"
        if not path.exists():
            self._build(path, "-c", str(HERE / f"{name}.cpp"))
        return str(path)

    def _build(self, path: Path, *arguments: str) -> None:
        mine = path.with_name(f"{os.getpid()}-{path.name}")  # others may be at the same
        subprocess.run([self.compiler, *FLAGS, *arguments, "-o", str(mine)], check=True)
        mine.replace(path)


class BrokenDevice(EmulatedDevice):
    """Takes its kernels from broken.cu."""

    def source(self, name: str) -> str:
        """The file of all of them."""
        return str(HERE / "broken.cu")


class Numbers(ctypes.Structure):
    """What the kernels of broken.cu take."""

    _fields_ = (("to", ctypes.c_void_p),)
