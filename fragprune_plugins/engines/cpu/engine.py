"""The compiled CPU rasterizer as an engine: tensors in, tensors out, every gradient."""

from __future__ import annotations

import ctypes
import weakref
from dataclasses import dataclass, field
from functools import partial

import torch
from torch import Tensor

from fragprune_plugins.engines.calling import (
    Wanted,
    empty,
    native_arrays,
    native_inputs,
    native_threads,
    new_outputs,
    plain,
    run,
    with_gradients,
)
from fragprune_plugins.engines.cpu import binding
from fragprune_plugins.types import RasterInputs, RasterOutputs

_STAGES = ("projection", "binning", "blend")


@dataclass
class _Drawing:
    """One forward pass: its non-differentiable inputs, and the data that it leaves for backward."""

    inputs: RasterInputs
    library: binding.Library
    workspace: binding.Workspace
    arrays: dict[str, Tensor]  # which C code reads for as long as its state lives
    state: int | None = None  # address of what backward needs, freed with the drawing
    evaluated: int = 0  # (Gaussian, pixel) lanes that were computed
    entries: int = 0  # (Gaussian, tile) pairs that were blended
    stages: dict[str, float] = field(default_factory=dict)  # milliseconds

    def draw(self, wanted: Wanted) -> dict[str, Tensor]:
        """Run the forward pass."""
        view, splats, fresh = self.inputs.view, self.inputs.splats, partial(empty, self.workspace)
        drawn = new_outputs(self.inputs, fresh, self.inputs.planes)
        if splats.flat and "surface" in self.inputs.planes:
            drawn["surface"] = fresh(6, view.height, view.width)
        if self.inputs.scores:
            drawn["weights_per_gaussian"] = fresh(len(splats))
        outputs = binding.Outputs(**drawn)
        given = native_inputs(
            self.inputs,
            self.arrays,
            widen="thresholds" in wanted,
            threads=native_threads(),
            workspace=self.workspace.handle,
        )
        handle = ctypes.c_void_p()
        run(self.library, "forward", given, outputs, ctypes.byref(handle) if wanted else None)
        if wanted:
            self.state = handle.value
            free = self.library.calls.fragprune_free
            weakref.finalize(self, free, handle.value).atexit = False
        else:
            self.arrays = {}
        self.evaluated, self.entries = outputs.evaluated, outputs.entries
        self.stages = {name: getattr(outputs, f"{name}_ms") for name in _STAGES}
        per_pixel = fresh().fill_(outputs.drawn / (view.width * view.height))
        return drawn | {"fragments_per_pixel": per_pixel}

    def undraw(self, wanted: Wanted, by: dict[str, Tensor]) -> dict[str, Tensor]:
        """Run the backward pass; returns gradients by name, float32 on the CPU."""
        assert self.state is not None
        by = {name: plain(grad) for name, grad in by.items()}
        per_pixel = by.pop("fragments_per_pixel", None)
        output_grads = binding.OutputGrads(
            fragments_per_pixel=0.0 if per_pixel is None else per_pixel.item(), **by
        )
        shapes = {name: array.shape for name, array in self.arrays.items()}
        shapes["hook"] = torch.Size((len(self.inputs.splats), 3))
        grads = {name: empty(self.workspace, *shapes[name]) for name in wanted}
        to = binding.InputGrads(**grads)
        run(self.library, "backward", self.state, output_grads, to, native_threads())
        return grads


class CpuEngine:
    """Rasterizes with the compiled library; results are the same, to the bit, for any threads.

    Attributes:
        library: the build that is used, by default the best one on this machine.
        sh_apart: it reads ``Splats.sh_rest``, so that nobody needs to join the coefficients.
    """

    name = "cpu"
    sh_apart = True

    def __init__(self, library: binding.Library | None = None) -> None:
        self.library = binding.library() if library is None else library
        self.workspace = binding.Workspace(self.library)

    def rasterize(self, inputs: RasterInputs, thresholds: Tensor | None) -> RasterOutputs:
        """Draw the splats; thresholds is (N,) falloff in (0, 1), or None for no truncation."""
        inputs.check_thresholds(thresholds)
        arrays = native_arrays(inputs, thresholds)
        drawing = _Drawing(inputs, self.library, self.workspace, arrays)
        drawn = with_gradients(inputs, thresholds, drawing.draw, drawing.undraw)
        there = {name: each.to(inputs.splats.device) for name, each in drawn.items()}
        pixels = inputs.view.width * inputs.view.height
        return RasterOutputs(
            evaluated_per_pixel=drawing.evaluated / pixels,
            entries_per_pixel=drawing.entries / pixels,
            stages=drawing.stages,
            **there,
        )
