"""Finds and opens the compiled rasterizer that suits this machine, and says why when it cannot."""

from __future__ import annotations

import ctypes
import os
import weakref
from collections.abc import Iterator
from contextlib import suppress
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import Any, Final

from fragprune_plugins import native
from fragprune_plugins.errors import EngineError

API_VERSION: Final = 11  # FRAGPRUNE_API_VERSION of ``include/fragprune.h`` that this module speaks
ENVIRONMENT: Final = "FRAGPRUNE_NATIVE"  # off, baseline, avx2 or avx512 overrides the choice
BUILDS: Final = {"avx512": 2, "avx2": 1, "baseline": 0}  # best first, with bits of cpu_features
_SUFFIX: Final = ".pyd" if os.name == "nt" else ".so"  # as setup.py names them

OK: Final = 0
OUT_OF_MEMORY: Final = 2

_POINTER = ctypes.c_void_p


class Error(ctypes.Structure):
    """fragprune_error."""

    _fields_ = (("message", ctypes.c_char * 256),)


class Named(ctypes.Structure):
    """A struct built from keyword arguments; fields that are not given are zero.

    Where a field is an address, tensors are given. Whoever makes the struct keeps them.
    """

    def __init__(self, **fields: Any) -> None:
        places = {name: kind == [_POINTER] for name, *kind in self._fields_}
        if unknown := fields.keys() - places.keys():  # ctypes would set what C never sees
            raise TypeError(f"{type(self).__name__} has no {', '.join(sorted(unknown))}")
        super().__init__(**{k: address(v) if places[k] else v for k, v in fields.items()})


def address(value: Any) -> Any:
    """Of a tensor the address of its first number, None if it is empty; another value as it is."""
    if not hasattr(value, "data_ptr"):
        return value
    return value.data_ptr() if value.numel() else None


def several(kind: Any, names: str) -> tuple[tuple[str, Any], ...]:
    """Fields of a struct that are of one kind, by their names in one string."""
    return tuple((name, kind) for name in names.split())


def pointers(names: str) -> tuple[tuple[str, Any], ...]:
    """Fields of a struct that are addresses, likewise."""
    return several(_POINTER, names)


class Sized(Named):
    """A struct whose first field is its own size."""

    _fields_ = several(ctypes.c_uint32, "size")

    def __init__(self, **fields: Any) -> None:
        super().__init__(**fields)
        self.size = ctypes.sizeof(self)


class Lengths(Named):
    """fragprune_lengths."""

    _fields_ = (
        *several(ctypes.c_int64, "viewmatrix projmatrix campos background means opacities scales"),
        *several(ctypes.c_int64, "rotations cov3d sh colors features thresholds sample_offsets"),
        *several(ctypes.c_int64, "means2d conics depths tiles times scales_t rotations_r sh_rest"),
    )


ARRAYS: Final = tuple(name for name, *_ in Lengths._fields_)
"""The arrays that go in, by name: of a rasterization, and of a cut in time."""


class Inputs(Sized):
    """fragprune_inputs."""

    _fields_ = (
        *several(ctypes.c_int32, "threads width height"),
        *several(ctypes.c_float, "tan_fov_x tan_fov_y scale_modifier dilation near alpha_max stop"),
        *several(ctypes.c_int32, "compensation cap_gradient absolute_gradient sh_degree"),
        *several(ctypes.c_int32, "sh_coefficients feature_count widen flat soft"),
        ("count", ctypes.c_int64),
        ("lengths", Lengths),
        *pointers("viewmatrix projmatrix campos background means opacities scales rotations"),
        *pointers("cov3d sh sh_rest colors features thresholds sample_offsets"),
        *pointers("means2d conics depths tiles workspace"),
    )


class Outputs(Sized):
    """fragprune_outputs."""

    _fields_ = (
        *pointers("image invdepth alpha radii features fragments fragments_per_gaussian"),
        *pointers("weights_per_gaussian wins_per_gaussian winners surface"),
        *several(ctypes.c_int64, "drawn evaluated entries"),
        *several(ctypes.c_float, "projection_ms binning_ms blend_ms"),
    )


class OutputGrads(Sized):
    """fragprune_output_grads."""

    _fields_ = (
        ("fragments_per_pixel", ctypes.c_float),
        *pointers("image invdepth alpha features surface"),
    )


class InputGrads(Sized):
    """fragprune_input_grads."""

    _fields_ = (
        *pointers("means hook opacities scales rotations cov3d sh sh_rest colors features"),
        *pointers("thresholds means2d conics depths background"),
    )


class Photometric(Sized):
    """fragprune_photometric."""

    _fields_ = (
        *several(ctypes.c_int32, "threads channels height width"),
        *several(ctypes.c_float, "l1_weight ssim_weight"),
        *pointers("image target gradient workspace"),
        *several(ctypes.c_double, "l1 dissimilarity"),
    )


@dataclass(frozen=True)
class Library:
    """An opened build."""

    build: str  # baseline, avx2 or avx512
    path: str
    lanes: int  # pixels that one instruction handles
    calls: ctypes.CDLL  # its C functions, as ctypes objects


class Unavailable(Exception):  # noqa: N818 - a state of this machine
    """No build can be used here; the message says why."""


def open_build(build: str) -> Library:
    """Open one build, whose file is no Python module, and check the version of its interface."""
    path = str(Path(native.__file__).with_name(f"_cpu_{build}{_SUFFIX}"))
    if not os.path.isfile(path):
        raise Unavailable(f"the {build} build is not installed (was there a C++17 compiler?)")
    try:
        calls = ctypes.CDLL(path)
        version = int(calls.fragprune_version())
    except (OSError, AttributeError) as error:
        raise Unavailable(f"{path} cannot be opened: {error}") from error
    if version != API_VERSION:
        raise Unavailable(f"{path} speaks version {version}, this package {API_VERSION}; reinstall")
    at, size, whole = ctypes.POINTER, ctypes.c_uint64, ctypes.c_int32
    for name, result, *arguments in (
        ("forward", whole, at(Inputs), at(Outputs), at(_POINTER), at(Error)),
        ("backward", whole, _POINTER, at(OutputGrads), at(InputGrads), whole, at(Error)),
        ("photometric_loss", whole, at(Photometric), at(Error)),
        ("free", None, _POINTER),
        ("workspace_new", _POINTER),
        ("workspace_free", None, _POINTER),
        ("workspace_take", _POINTER, _POINTER, size),
        ("workspace_give", None, _POINTER, _POINTER, size),
    ):
        call = getattr(calls, f"fragprune_{name}")
        call.restype, call.argtypes = result, arguments
    return Library(build, path, int(calls.fragprune_lanes()), calls)


def cpu_features() -> int:
    """This machine's bits of fragprune_cpu_features, by the baseline, or Unavailable."""
    return int(open_build("baseline").calls.fragprune_cpu_features())


def _usable(features: int) -> Iterator[Library]:
    """The builds that are installed and run on a machine with these features, best first."""
    for build, needs in BUILDS.items():
        if needs & ~features == 0:
            with suppress(Unavailable):
                yield open_build(build)


def usable_builds() -> list[str]:
    """The builds that are installed and run on this machine, best first."""
    with suppress(Unavailable):
        return [each.build for each in _usable(cpu_features())]
    return []


@cache
def _chosen(wanted: str) -> Library | str:
    """The build of this name, the best one for "", or the reason why there is none."""
    if wanted in ("off", "0"):
        return f"switched off by {ENVIRONMENT}={wanted}"
    if wanted and wanted not in BUILDS:
        return f"{ENVIRONMENT}={wanted} is not one of {', '.join(['off', *BUILDS])}"
    try:
        features = cpu_features()
        if not wanted:
            return next(_usable(features))
        if BUILDS[wanted] & ~features:
            return f"{ENVIRONMENT}={wanted}, which this processor lacks"
        return open_build(wanted)
    except Unavailable as why:
        return str(why)


def chosen() -> Library | str:
    """The library that the environment asks for, or the reason why there is none."""
    return _chosen(os.environ.get(ENVIRONMENT, "").strip().lower())


def available() -> bool:
    """Whether a compiled rasterizer can be used here."""
    return isinstance(chosen(), Library)


def library() -> Library:
    """The opened build."""
    answer = chosen()
    if isinstance(answer, Library):
        return answer
    remedy = "Reinstall where a C++17 compiler is found, or use the engine 'reference'."
    raise EngineError("engine 'cpu'", answer, "a compiled rasterizer", remedy)


class Workspace:
    """Owns a fragprune_workspace: memory that calls reuse. Any thread may use it.

    Attributes:
        handle: the C pointer; None if memory was short.
    """

    def __init__(self, opened: Library) -> None:
        self._calls = opened.calls
        self.handle: int | None = opened.calls.fragprune_workspace_new()

    def take(self, size: int) -> ctypes.Array[ctypes.c_char]:
        """A buffer of `size` bytes; its memory returns to the workspace with the last reference."""
        address = self._calls.fragprune_workspace_take(self.handle, size) if self.handle else None
        if address is None:
            raise MemoryError("fragprune's cpu engine: out of memory")
        buffer = (ctypes.c_char * size).from_address(address)
        weakref.finalize(buffer, self._give, address, size).atexit = False
        return buffer

    def _give(self, address: int, size: int) -> None:
        self._calls.fragprune_workspace_give(self.handle, address, size)

    def __del__(self) -> None:
        if self.handle is not None:
            self._calls.fragprune_workspace_free(self.handle)
            self.handle = None
