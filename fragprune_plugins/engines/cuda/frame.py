"""The kernels of one rasterization on a GPU: their order, arguments and memory.

All memory is torch's, and all work goes to torch's current stream. This module does not use the
driver. A ``Device`` runs a kernel by name: a GPU (``cuda.driver``) or, in tests, an emulation.
"""

from __future__ import annotations

import ctypes
import math
from collections.abc import Callable, Hashable
from functools import partial
from typing import Final, Protocol, get_args

import torch
from torch import Tensor

from fragprune_plugins.constants import TILE
from fragprune_plugins.engines.calling import (
    Wanted,
    native_arrays,
    native_inputs,
    new_outputs,
    plain,
)
from fragprune_plugins.engines.cpu import binding
from fragprune_plugins.errors import EngineError
from fragprune_plugins.types import Plane, RasterInputs

# What native/cuda/frame.h says.
THREADS: Final = 256
SORT_KEYS: Final = 16 * THREADS
PASSES: Final = 4
DIGITS: Final = 256
BRUSH: Final = 12
COUNTERS: Final = 4 * 8 + 4 * (2 + 2 * PASSES)

ENTRIES_MAX: Final = (1 << 30) - 1  # most entries of all tiles' lists: the sort counts with 30 bits
OFFSET_MAX: Final = 1e6  # farthest that a pixel may be sampled from its place, as in the cpu engine

_GEOMETRY: Final = frozenset(
    ("means", "hook", "scales", "rotations", "cov3d", "means2d", "conics", "depths")
)


class Frame(binding.Named):
    """fp::Frame: the argument of a forward pass's kernels."""

    _fields_ = (
        ("inputs", binding.Inputs),
        ("outputs", binding.Outputs),
        ("spread", ctypes.c_void_p),
        ("capacity", ctypes.c_uint32),
        *binding.several(ctypes.c_int32, "tiles_x tiles_y tile_passes"),
        *binding.pointers("counters project_words emit_words depth_histogram"),
        *binding.pointers("tile_histogram ranges"),
        *binding.pointers("brushes rects tiles first_slot depth_keys depth_ids"),
        *binding.pointers("entry_keys entry_values owners reached transmittance"),
        *binding.pointers("stop weights"),
    )


_PLACES: Final = frozenset(name for name, *kind in Frame._fields_ if kind == [ctypes.c_void_p])
"""What of it is an address; an array of this name is there."""


class Sort(binding.Named):
    """fp::Sort: one pass of the radix sort."""

    _fields_ = (
        ("count", ctypes.c_void_p),
        ("capacity", ctypes.c_uint32),
        ("shift", ctypes.c_int32),
        *binding.pointers("histogram words ticket keys values sorted_keys sorted_values"),
    )


class Undraw(binding.Named):
    """fp::Undraw: the argument of a backward pass's kernels."""

    _fields_ = (
        ("frame", Frame),
        ("by", binding.OutputGrads),
        ("to", binding.InputGrads),
        *binding.pointers("by_fragments background sums"),
        ("ceiling", ctypes.c_float),
    )


MACROS: Final = {
    "FP_FRAME_SIZE": ctypes.sizeof(Frame),
    "FP_SORT_SIZE": ctypes.sizeof(Sort),
    "FP_UNDRAW_SIZE": ctypes.sizeof(Undraw),
}
"""What every source is compiled with, to check that it knows the same structs."""


def blend_macros(
    features: int = 0, *, counts: bool = False, scores: bool = False, stop: bool = False
) -> dict[str, int]:
    """The macros with which native/cuda/blend.cu is compiled."""
    return {
        "FP_FEATURES": features,
        "FP_COUNTS": int(counts),
        "FP_SCORES": int(scores),
        "FP_STOP": int(stop),
    }


def unblend_macros(
    wanted: Wanted,
    *,
    sh_turns: bool,
    invdepth: bool = False,
    absolute: bool = False,
    offsets: bool = False,
    features: int = 0,
) -> dict[str, int]:
    """The macros with which native/cuda/unblend.cu is compiled.

    With ``sh_turns`` colours depend on the direction; ``absolute`` fills the hook's third column.
    """
    colour = bool(wanted & {"colors", "sh"}) or ("means" in wanted and sh_turns)
    return {
        "FP_GEOMETRY": int(bool(wanted & _GEOMETRY)),
        "FP_COLOUR": int(colour),
        "FP_THRESHOLD": int("thresholds" in wanted),
        "FP_DEPTH": int(invdepth),
        "FP_ABSOLUTE": int("hook" in wanted and absolute),
        "FP_OFFSETS": int(offsets),
        "FP_FEATURES": features,
    }


class Device(Hashable, Protocol):
    """Runs kernels by name: a GPU, or its emulation.

    Attributes:
        kind: torch's name for the type of device that the tensors live on.
    """

    kind: str

    def launch(
        self,
        where: torch.device,
        source: str,
        macros: dict[str, int],
        kernel: str,
        blocks: int,
        arguments: ctypes.Structure,
    ) -> None:
        """Run a kernel of native/cuda/``source``.cu, compiled with these macros.

        Asynchronous, on the current stream; ``arguments`` is copied before this returns.
        """


class Arena:
    """Named arrays, of these sizes in bytes, in one tensor, each at a multiple of 256 bytes."""

    def __init__(self, where: torch.device, fill: Callable[..., Tensor], **sizes: int) -> None:
        self.filled = {name for name, size in sizes.items() if size}
        places, total = {}, 0
        for name, size in sizes.items():
            places[name] = total
            total += -(-size // 256) * 256
        self.memory = fill(total + 255, dtype=torch.uint8, device=where)
        first = -self.memory.data_ptr() % 256
        self._at = {name: first + place for name, place in places.items()}

    def __getitem__(self, name: str) -> int:
        return self.memory.data_ptr() + self._at[name]

    def numbers(self, name: str, count: int) -> Tensor:
        """An array's first int64 numbers as a tensor."""
        return self.memory[self._at[name] :][: 8 * count].view(torch.int64)


def blocks_of(count: int, per_block: int = THREADS) -> int:
    """How many blocks of threads serve so many."""
    return -(-count // per_block)


def launch(
    device: Device,
    where: torch.device,
    source: str,
    macros: dict[str, int],
    kernel: str,
    blocks: int,
    arguments: ctypes.Structure,
) -> None:
    """Run a kernel unless it has no work."""
    if blocks:
        device.launch(where, source, {**MACROS, **macros}, kernel, blocks, arguments)


def launch_sort(
    device: Device,
    where: torch.device,
    arguments: Sort,
    keys: list[int],
    values: list[int],
    passes: int,
) -> None:
    """Sort 8 bits in each pass, alternating between two pairs of arrays."""
    blocks = blocks_of(arguments.capacity, SORT_KEYS)
    for k in range(passes):
        arguments.keys, arguments.sorted_keys = keys[k % 2], keys[1 - k % 2]
        arguments.values, arguments.sorted_values = values[k % 2], values[1 - k % 2]
        launch(device, where, "scene", {}, "fp_sort", blocks, arguments)
        arguments.shift += 8
        arguments.histogram += 4 * DIGITS
        arguments.words += 4 * DIGITS * blocks
        arguments.ticket += 4


class Drawing:
    """One rasterization: its forward pass, the data kept for backward, its backward pass.

    It does not hold its own outputs. The outputs hold autograd's graph, and the graph holds the
    drawing. A reference back would be a cycle through C++, which no garbage collector finds.

    Attributes:
        evaluated: (Gaussian, pixel) lanes that were computed; NaN until read.
        entries: (Gaussian, tile) pairs in the lists; NaN until read.
    """

    evaluated: float = math.nan
    entries: float = math.nan

    def __init__(self, device: Device, inputs: RasterInputs, thresholds: Tensor | None) -> None:
        self._device, self._inputs, self._n = device, inputs, len(inputs.splats)
        self.where = inputs.splats.device
        self._launch = partial(launch, device, self.where)
        # what kernels write, whatever the host has made torch's default
        self._new = partial(torch.empty, dtype=torch.float32, device=self.where)
        view = inputs.view
        self._arrays = native_arrays(inputs, thresholds, self.where)
        offsets = self._arrays.get("sample_offsets")
        self._spread = None if offsets is None else offsets.abs().amax()
        self._across, self._down = -(-view.width // TILE), -(-view.height // TILE)
        self._tiles, self._pixels = self._across * self._down, view.width * view.height
        self._passes = max(1, blocks_of((self._tiles - 1).bit_length(), 8))
        self._channels = 0 if inputs.splats.features is None else inputs.splats.features.shape[1]
        self._frame: Frame | None = None

    # ---- forward -------------------------------------------------------------------------------

    def draw(self, capacity: int, wanted: Wanted, *, deterministic: bool) -> dict[str, Tensor]:
        """Launch the forward pass. Its result is invalid if entries exceed the capacity.

        Args:
            capacity: the number of list entries, over all tiles, to allocate room for.
            deterministic: give each entry its own slot, so that backward can add in order.
        """
        inputs, n, where = self._inputs, self._n, self.where
        keep = bool(wanted)
        cleared, scratch, kept = self._room(capacity, keep, keep and deterministic)
        planes = get_args(Plane)  # the kernels spare none
        outputs = new_outputs(inputs, self._new, planes)
        for name in outputs.keys() & {"fragments_per_gaussian", "wins_per_gaussian"}:
            outputs[name].zero_()  # the kernels add to these
        weights = torch.zeros(n, dtype=torch.int64, device=where) if inputs.scores else None
        arenas = (cleared, scratch, kept)
        places = {k: arena[k] for arena in arenas for k in arena.filled & _PLACES}
        frame = Frame(
            inputs=native_inputs(inputs, self._arrays, widen="thresholds" in wanted),
            outputs=binding.Outputs(**outputs),
            spread=self._spread,
            capacity=capacity,
            tiles_x=self._across,
            tiles_y=self._down,
            tile_passes=self._passes,
            weights=weights,
            **places,
        )
        self._list(frame, *arenas)
        macros = blend_macros(
            self._channels, counts=inputs.counts, scores=inputs.scores, stop=inputs.stop is not None
        )
        self._launch("blend", macros, "fp_blend", self._tiles, frame)
        found = self._found = cleared.numbers("counters", 4)
        if keep:
            frame.outputs = binding.Outputs()  # backward does without
            self._frame = frame
        self._memory = (cleared, kept)
        per_pixel = (found[2].double() / self._pixels).float()
        if weights is not None:
            outputs["weights_per_gaussian"] = (weights.double() * 2.0**-32).float()
        return outputs | {"fragments_per_pixel": per_pixel}

    def _room(self, capacity: int, keep: bool, slots: bool) -> tuple[Arena, Arena, Arena]:
        """A frame's memory: what begins with zeros, what makes the lists, and what backward reads.

        With ``keep`` backward will come; with ``slots`` it adds lists' entries in a fixed order.
        """
        n, where, pixels = self._n, self.where, self._pixels
        cleared = Arena(
            where,
            torch.zeros,
            counters=COUNTERS,
            project_words=8 * blocks_of(n),
            emit_words=8 * blocks_of(n),
            depth_histogram=4 * PASSES * DIGITS,
            tile_histogram=4 * PASSES * DIGITS,
            depth_sort=4 * PASSES * DIGITS * blocks_of(n, SORT_KEYS),
            tile_sort=4 * self._passes * DIGITS * blocks_of(capacity, SORT_KEYS),
            ranges=8 * self._tiles,
        )
        scratch = Arena(
            where,
            torch.empty,
            rects=8 * n,
            **dict.fromkeys(("depth_keys", "depth_ids", "keys_2", "ids_2"), 4 * n),
            **dict.fromkeys(("entry_keys", "entry_keys_2", "entry_values_2"), 4 * capacity),
        )
        kept = Arena(
            where,
            torch.empty,
            brushes=4 * BRUSH * n,
            tiles=4 * n,
            first_slot=4 * n * slots,
            entry_values=4 * capacity,
            owners=4 * capacity * slots,
            reached=capacity * keep,
            transmittance=4 * pixels * keep,
            stop=4 * pixels * keep,
        )
        return cleared, scratch, kept

    def _list(self, frame: Frame, cleared: Arena, scratch: Arena, kept: Arena) -> None:
        """Project the Gaussians, and list them by tile and depth."""
        n, capacity, passes = self._n, frame.capacity, self._passes
        keys = [scratch["entry_keys"], scratch["entry_keys_2"]]
        values = [kept["entry_values"], scratch["entry_values_2"]]
        if passes % 2:  # the last sorting pass of the entries must end in `kept`
            values.reverse()
        frame.entry_keys, frame.entry_values = keys[0], values[0]
        counters = cleared["counters"]
        by_depth = Sort(
            count=counters,
            capacity=n,
            histogram=cleared["depth_histogram"],
            words=cleared["depth_sort"],
            ticket=counters + 4 * 8 + 4 * 2,
        )
        by_tile = Sort(
            count=counters + 8,
            capacity=capacity,
            histogram=cleared["tile_histogram"],
            words=cleared["tile_sort"],
            ticket=counters + 4 * 8 + 4 * (2 + PASSES),
        )
        self._launch("scene", {}, "fp_project", blocks_of(n), frame)
        ids = [scratch["depth_ids"], scratch["ids_2"]]
        depths = [scratch["depth_keys"], scratch["keys_2"]]
        launch_sort(self._device, self.where, by_depth, depths, ids, PASSES)
        self._launch("scene", {}, "fp_emit", blocks_of(n), frame)
        if n:
            launch_sort(self._device, self.where, by_tile, keys, values, passes)
            frame.entry_keys, frame.entry_values = keys[passes % 2], values[passes % 2]
            self._launch("scene", {}, "fp_ranges", blocks_of(capacity), frame)

    def read(self) -> int:
        """Wait for the GPU, then return the number of entries."""
        _, entries, _, self.evaluated = map(int, self._found.tolist())
        self.entries = entries
        if entries > ENTRIES_MAX:
            found = f"{entries} entries in the tiles' lists"
            remedy = "Draw fewer Gaussians or a smaller image."
            raise EngineError("engine 'cuda'", found, f"at most {ENTRIES_MAX}", remedy)
        if self._spread is not None and not self._spread <= OFFSET_MAX:
            found = f"sample_offsets up to {float(self._spread)}"
            expected = f"at most {OFFSET_MAX:g} pixels"
            raise EngineError("engine 'cuda'", found, expected, "Check the offsets.")
        return entries

    # ---- backward ------------------------------------------------------------------------------

    def undraw(self, wanted: Wanted, by: dict[str, Tensor]) -> dict[str, Tensor]:
        """Run the backward pass: from the outputs' gradients to the inputs', by name."""
        assert self._frame is not None
        inputs, frame, n, where = self._inputs, self._frame, self._n, self.where
        by = {name: plain(grad, where) for name, grad in by.items()}
        per_pixel = by.pop("fragments_per_pixel", None)
        macros = unblend_macros(
            wanted,
            sh_turns="sh" in self._arrays and frame.inputs.sh_degree > 0,
            invdepth="invdepth" in by,
            absolute=inputs.absolute_gradient,
            offsets=self._spread is not None,
            features=self._channels if "features" in by else 0,
        )
        sums = 1 + sum(macros[f"FP_{k}"] for k in ("THRESHOLD", "DEPTH", "ABSOLUTE", "FEATURES"))
        sums += 5 * macros["FP_GEOMETRY"] + 3 * macros["FP_COLOUR"]
        shapes = {name: array.shape for name, array in self._arrays.items()}
        shapes["hook"] = torch.Size((n, 3))
        grads = {name: self._new(shapes[name]) for name in wanted - {"background"}}
        by_tile = self._new(self._tiles, 3) if "background" in wanted else None
        per_gaussian = n > 0 and bool(grads)
        rows = frame.capacity if frame.owners else n
        room = self._new(rows * sums).zero_() if per_gaussian else None
        if "features" in grads and "features" not in by:
            grads["features"].zero_()
        arguments = Undraw(
            frame=frame,
            by=binding.OutputGrads(**by),
            to=binding.InputGrads(**grads),
            by_fragments=per_pixel,
            background=by_tile,
            sums=room,
            ceiling=math.inf if inputs.cap_gradient else inputs.alpha_max,
        )
        self._launch("unblend", macros, "fp_unblend", self._tiles, arguments)
        if per_gaussian:
            self._launch("unblend", macros, "fp_chain", blocks_of(n), arguments)
        if by_tile is not None:
            grads["background"] = by_tile.sum(0, dtype=torch.float64).float()
        return grads
