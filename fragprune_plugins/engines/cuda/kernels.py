"""Compiles the GPU's kernels at first use, and keeps the compiled code.

The compiler is NVRTC, through ``cuda.bindings``. It needs no headers of Python and torch.
"""

from __future__ import annotations

import hashlib
import os
from contextlib import ExitStack, suppress
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import Any, Final

from filelock import FileLock, Timeout

from fragprune_plugins import native

ENVIRONMENT: Final = "FRAGPRUNE_CUDA"  # set to off, it switches the cuda engine off
CACHE: Final = "FRAGPRUNE_CACHE"  # a folder for kernels, not the platform's

SOURCES: Final = Path(native.__file__).parent / "cuda"

OLDEST: Final = 70  # major x 10 + minor: warps' matching and independent lanes
_OPTIONS: Final = ("--std=c++17", "--fmad=false")  # no contraction: native/cuda/numbers.cuh

_STDINT: Final = b"""
typedef signed char int8_t; typedef unsigned char uint8_t;
typedef short int16_t; typedef unsigned short uint16_t;
typedef int int32_t; typedef unsigned int uint32_t;
typedef long long int64_t; typedef unsigned long long uint64_t;
"""


class Unavailable(Exception):  # noqa: N818 - a state of this machine
    """Kernels cannot be compiled here; the message gives the reason."""


@dataclass(frozen=True)
class Image:
    """A compiled source: machine code, or PTX, and the compiler's output."""

    code: bytes
    log: str


class Nvrtc:
    """The run-time compiler, a shared library.

    Attributes:
        version: of the toolkit.
        architectures: compute capabilities for which it makes machine code, ascending.

    Raises:
        Unavailable: it is not here.
    """

    name = "nvrtc"

    def __init__(self) -> None:
        try:
            from cuda.bindings import nvrtc
        except ImportError as error:
            raise Unavailable(f"cuda-bindings is not installed ({error})") from error
        self._nvrtc: Any = nvrtc
        try:
            major, minor = self._call("nvrtcVersion")
            found = self._call("nvrtcGetSupportedArchs")[0]
        except Unavailable:
            raise
        except Exception as error:  # of several types, by version: the library cannot be found
            raise Unavailable(f"no NVRTC library: {str(error).splitlines()[0]}") from error
        self.version = f"{major}.{minor}"
        self.architectures = tuple(sorted(int(a) for a in found if a >= OLDEST))

    def compile(self, source: str, macros: dict[str, int], target: str) -> Image:
        """Compile native/cuda/``source``.cu for a target like sm_90 or compute_90."""
        text = (SOURCES / f"{source}.cu").read_bytes()
        program = self._call(
            "nvrtcCreateProgram", text, f"{source}.cu".encode(), 1, [_STDINT], [b"stdint.h"]
        )[0]
        options = [
            *_OPTIONS,
            *(f"-D{name}={value}" for name, value in macros.items()),
            f"--gpu-architecture={target}",
            f"--include-path={SOURCES}",
            "--device-as-default-execution-space",
            "--ptxas-options=-v",
        ]
        try:
            encoded = [option.encode() for option in options]
            self._call("nvrtcCompileProgram", program, len(encoded), encoded)
            what = "CUBIN" if target.startswith("sm_") else "PTX"
            code = self._text(program, f"nvrtcGet{what}Size", f"nvrtcGet{what}")
            return Image(code, self._log(program))
        except Unavailable as failure:
            said = f"{source}.cu for {target}: {failure}\n{self._log(program)}"
            raise Unavailable(said) from None
        finally:
            self._call("nvrtcDestroyProgram", program)

    def _log(self, program: Any) -> str:
        text = self._text(program, "nvrtcGetProgramLogSize", "nvrtcGetProgramLog")
        return text.decode(errors="replace").rstrip("\0 \n")

    def _text(self, program: Any, size: str, get: str) -> bytes:
        buffer = bytes(self._call(size, program)[0])
        self._call(get, program, buffer)
        return buffer

    def _call(self, function: str, *arguments: Any) -> tuple[Any, ...]:
        status, *results = getattr(self._nvrtc, function)(*arguments)
        if int(status) != 0:
            raise Unavailable(f"{function}: {status.name}")
        return tuple(results)


_opened = cache(Nvrtc)


def compiler() -> Nvrtc:
    """The compiler, opened once."""
    if os.environ.get(ENVIRONMENT, "").strip().lower() in ("off", "0"):
        raise Unavailable(f"switched off by {ENVIRONMENT}")
    return _opened()


def target_of(capability: int, architectures: tuple[int, ...]) -> str:
    """The target of a capability, major x 10 + minor: machine code, or PTX for an older one."""
    if capability in architectures:
        return f"sm_{capability}"
    if not (older := [code for code in architectures if code <= capability]):
        least = min(architectures, default=OLDEST) / 10
        raise Unavailable(f"compute capability {capability / 10} is older than {least}")
    return f"compute_{max(older)}"


# ---- what was compiled before ------------------------------------------------------------------


def cache_folder() -> Path:
    """Where compiled kernels are kept: $FRAGPRUNE_CACHE, or the platform's cache folder."""
    if named := os.environ.get(CACHE):
        return Path(named)
    try:
        from platformdirs import user_cache_path
    except ImportError:  # without the extra
        return Path.home() / ".cache" / "fragprune" / "kernels"
    return user_cache_path("fragprune") / "kernels"


@cache
def digest_of_sources() -> bytes:
    """A digest of all files that kernels may include."""
    digest = hashlib.sha256()
    parent = SOURCES.parent
    for folder in ("cuda", "cpu", "include"):
        for path in sorted((parent / folder).iterdir()):
            if path.suffix in (".cu", ".cuh", ".h"):
                digest.update(f"{path.name}\0".encode() + path.read_bytes())
    return digest.digest()


def image_of(source: str, macros: dict[str, int], target: str, by: Nvrtc) -> tuple[Image, bool]:
    """A compiled source of native/cuda, and whether it was in the cache, or Unavailable.

    Processes that need the same source at the same time wait for the first of them. If the folder
    cannot be written, nothing is kept.
    """
    what = repr((by.name, by.version, _OPTIONS, source, sorted(macros.items()), target))
    digest = hashlib.sha256(digest_of_sources() + what.encode()).hexdigest()[:24]
    path = cache_folder() / f"{source}-{target}-{digest}.bin"
    with ExitStack() as held:
        # Where nothing can be locked, two processes may write the same file in turn; neither reads
        # a partial one: a read-only folder, a lock of a process that hangs, no locks in the system.
        with suppress(OSError, Timeout, NotImplementedError):
            path.parent.mkdir(parents=True, exist_ok=True)
            held.enter_context(FileLock(f"{path}.lock", timeout=300))
        if (kept := _read(path)) is not None:
            return kept, True
        image = by.compile(source, macros, target)
        with suppress(OSError):  # read-only, or full
            _write(path, image)
        return image, False


def _read(path: Path) -> Image | None:
    """Read an image from the cache; None if it is absent or damaged."""
    try:
        digest, log_size, rest = path.read_bytes().split(b"\n", 2)
    except (OSError, ValueError):
        return None
    if hashlib.sha256(rest).hexdigest().encode() != digest:
        return None
    size = int(log_size)
    return Image(rest[size:], rest[:size].decode())


def _write(path: Path, image: Image) -> None:
    """Write an image to the cache; readers see all of it or nothing."""
    log = image.log.encode()
    rest = log + image.code
    new = path.with_name(f"{path.name}.{os.urandom(8).hex()}")  # tempfile's are for one user alone
    new.write_bytes(f"{hashlib.sha256(rest).hexdigest()}\n{len(log)}\n".encode() + rest)
    os.replace(new, path)
