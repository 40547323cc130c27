"""A device that runs the kernels' own sources on the CPU, thread by thread, in shuffled order."""

from __future__ import annotations

import ctypes
import hashlib
import os
import shlex
import shutil
import subprocess
import sys
from contextlib import suppress
from pathlib import Path
from typing import Final

import torch

from fragprune_plugins import native
from fragprune_plugins.engines.cuda import kernels
from fragprune_plugins.errors import KernelError

EMULATION: Final = Path(native.__file__).parent / "emulation"
_COMPILERS: Final = ("g++", "c++", "clang++")
_FLAGS: Final = (
    *("-std=c++17", "-O1", "-w", "-ffp-contract=off", "-fno-math-errno", "-fPIC", "-shared"),
    *("-fvisibility=hidden", f"-I{EMULATION}"),
)


def find_compiler() -> str | None:
    """The C++ compiler: $CXX, or the first that is installed; None where nothing is emulated."""
    if sys.platform != "linux":  # shared memory is a section, as ELF has them
        return None
    return os.environ.get("CXX") or next(filter(None, map(shutil.which, _COMPILERS)), None)


def version_of(compiler: str) -> str:
    """What a compiler calls itself."""
    command = [*shlex.split(compiler), "--version"]
    with suppress(OSError):
        said = subprocess.run(command, capture_output=True, text=True, errors="replace").stdout
        return next(iter(said.splitlines()), compiler)
    return compiler


class EmulatedDevice:
    """Builds a source once per set of macros, by a C++17 compiler for ELF systems, in a folder."""

    kind = "cpu"

    def __init__(self, compiler: str, folder: Path, flags: tuple[str, ...] = ()) -> None:
        self.compiler, self.folder, self._flags = compiler, folder, flags
        self.seed = 1  # of the order in which threads and blocks run
        self.resident = 3  # blocks that run at a time, 1 to 3
        self.launched: list[tuple[str, dict[str, int]]] = []  # kernels with their macros, in order
        self.opened: dict[tuple[str, tuple[tuple[str, int], ...]], ctypes.CDLL] = {}

    def launch(
        self,
        where: torch.device,
        source: str,
        macros: dict[str, int],
        kernel: str,
        blocks: int,
        arguments: ctypes.Structure,
    ) -> None:
        """Run a kernel to its end; KernelError if its source does not compile.

        If its threads wait for each other forever, or meet at different operations, RuntimeError.
        """
        self.launched.append((kernel, macros))
        library = self._open(source, macros)
        grid, order = (blocks, 256), (self.seed, self.resident)
        if library.emulated_launch(kernel.encode(), *grid, ctypes.byref(arguments), *order):
            raise RuntimeError(library.emulated_message().decode())

    def source(self, name: str) -> Path:
        """The file of a source."""
        return kernels.SOURCES / f"{name}.cu"

    def _open(self, source: str, macros: dict[str, int]) -> ctypes.CDLL:
        key = (source, tuple(sorted(macros.items())))
        if key not in self.opened:
            name = hashlib.sha256(repr((self.source(source), key)).encode()).hexdigest()[:16]
            path = self.folder / f"{source}-{name}.so"
            defined = [f"-D{name}={value}" for name, value in macros.items()]
            header = str(EMULATION / "emulation.h")
            text = ("-x", "c++", "-include", header, str(self.source(source)))
            if not path.exists():
                self._compile(path, *self._flags, *defined, *text)
            library = ctypes.CDLL(str(path))
            library.emulated_message.restype = ctypes.c_char_p
            self.opened[key] = library
        return self.opened[key]

    def _compile(self, path: Path, *text: str) -> None:
        self._build(path, "-shared", self._part(EMULATION / "emulation.cpp"), *text)

    def _part(self, source: Path) -> str:
        """A source of the emulation itself, compiled once."""
        path = self.folder / f"{source.stem}.o"
        if not path.exists():
            self._build(path, "-c", str(source))
        return str(path)

    def _build(self, path: Path, *arguments: str) -> None:
        mine = path.with_name(f"{os.getpid()}-{path.name}")  # others may be at the same
        command = [*shlex.split(self.compiler), *_FLAGS, *arguments, "-o", str(mine)]
        try:
            subprocess.run(command, check=True, capture_output=True, text=True, errors="replace")
        except (OSError, subprocess.CalledProcessError) as error:
            said = getattr(error, "stderr", None) or str(error)
            found = next((line for line in said.splitlines() if "error" in line), said.strip())
            expected = f"sources that {self.compiler} compiles as C++17"
            remedy = "Name another compiler with CXX, such as g++."
            raise KernelError(f"the emulation of {path.stem}", found, expected, remedy) from error
        mine.replace(path)
