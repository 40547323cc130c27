"""The compiled CPU rasterizer as an engine: tensors in, tensors out, every gradient."""

from __future__ import annotations

import ctypes
from dataclasses import dataclass, field
from functools import partial
from typing import TYPE_CHECKING, Any

import torch
from torch.autograd.function import once_differentiable

from fragprune_plugins.engines.calling import (
    address,
    empty,
    expect_ok,
    native_arrays,
    native_inputs,
    native_threads,
    plain,
)
from fragprune_plugins.engines.cpu import binding
from fragprune_plugins.types import RasterOutputs, Splats

if TYPE_CHECKING:
    from torch import Tensor

    from fragprune_plugins.types import RasterInputs

# The differentiable inputs, in the order in which the autograd function takes them.
_NAMES = (
    "means",
    "hook",
    "opacities",
    "scales",
    "rotations",
    "cov3d",
    "sh",
    "sh_rest",
    "colors",
    "features",
    "thresholds",
    "means2d",
    "conics",
    "depths",
    "background",
)

_STAGES = ("projection", "binning", "blend")


@dataclass
class _Drawing:
    """One forward pass: its non-differentiable inputs, and the data that it leaves for backward.

    Attributes:
        arrays: the tensors that C code reads; they live as long as its state.
        state: the data that backward needs; None if no gradients are needed.
        evaluated: (Gaussian, pixel) lanes that were computed.
        entries: (Gaussian, tile) pairs that were blended.
        stages: milliseconds by stage.
        found: the requested counts and scores, by their names in ``RasterOutputs``.
    """

    inputs: RasterInputs
    library: binding.Library
    workspace: binding.Workspace
    arrays: dict[str, Tensor]
    state: binding.State | None = None
    evaluated: int = 0
    entries: int = 0
    stages: dict[str, float] = field(default_factory=dict)
    found: dict[str, Tensor] = field(default_factory=dict)

    def draw(self, wants: dict[str, bool]) -> tuple[Tensor, ...]:
        """Run the forward pass; returns the autograd function's outputs, in their order."""
        view, n = self.inputs.view, len(self.inputs.splats)
        size = (view.height, view.width)
        fresh = partial(empty, self.workspace)
        image, planes = fresh(3, *size), self.inputs.planes
        invdepth, alpha = (fresh(int(name in planes), *size) for name in ("invdepth", "alpha"))
        features = fresh(_channels(self.inputs.splats.features), *size)
        flat = isinstance(self.inputs.splats, Splats) and self.inputs.splats.flat
        surface = fresh(6 * (flat and "surface" in planes), *size)
        radii, whole = fresh(n, dtype=torch.int32), torch.int32
        if self.inputs.counts:
            self.found["fragments"] = fresh(*size, dtype=whole)
            self.found["fragments_per_gaussian"] = fresh(n, dtype=whole)
        if self.inputs.scores:
            self.found["weights_per_gaussian"] = fresh(n)
            self.found["wins_per_gaussian"] = fresh(n, dtype=whole)
            self.found["winners"] = fresh(*size, dtype=whole)
        outputs = binding.Outputs(
            image=address(image),
            invdepth=address(invdepth),
            alpha=address(alpha),
            radii=address(radii),
            features=address(features),
            surface=address(surface),
            **{name: address(tensor) for name, tensor in self.found.items()},
        )
        given = native_inputs(
            self.inputs,
            self.arrays,
            widen=wants["thresholds"],
            threads=native_threads(),
            workspace=self.workspace.handle,
        )
        error = binding.Error()
        handle = ctypes.c_void_p()
        keep = any(wants.values())
        status = self.library.calls.fragprune_forward(
            ctypes.byref(given),
            ctypes.byref(outputs),
            ctypes.byref(handle) if keep else None,
            ctypes.byref(error),
        )
        expect_ok(status, error)
        if keep:
            self.state = binding.State(self.library)
            self.state.handle = handle.value
        else:
            self.arrays = {}
        self.evaluated, self.entries = outputs.evaluated, outputs.entries
        self.stages = {name: getattr(outputs, f"{name}_ms") for name in _STAGES}
        drawn = torch.tensor(outputs.drawn / (view.width * view.height), dtype=torch.float32)
        return image, invdepth, alpha, features, surface, radii, drawn

    def undraw(self, upstream: tuple[Tensor | None, ...], wants: dict[str, bool]) -> dict[str, Any]:
        """Run the backward pass; returns gradients by name, float32 on the CPU."""
        assert self.state is not None
        by = [None if g is None else plain(g) for g in upstream]
        image, invdepth, alpha, features, surface, per_pixel = by
        output_grads = binding.OutputGrads(
            fragments_per_pixel=0.0 if per_pixel is None else per_pixel.item(),
            image=address(image),
            invdepth=address(invdepth),
            alpha=address(alpha),
            features=address(features),
            surface=address(surface),
        )
        n = len(self.inputs.splats)
        shapes = {name: array.shape for name, array in self.arrays.items()}
        shapes["hook"] = torch.Size((n, 3))
        grads = {k: empty(self.workspace, *shapes[k]) for k, wanted in wants.items() if wanted}
        error = binding.Error()
        status = self.library.calls.fragprune_backward(
            self.state.handle,
            ctypes.byref(output_grads),
            ctypes.byref(binding.InputGrads(**{k: address(g) for k, g in grads.items()})),
            native_threads(),
            ctypes.byref(error),
        )
        expect_ok(status, error)
        return grads


class _Rasterize(torch.autograd.Function):
    """The autograd function of a rasterization."""

    @staticmethod
    def forward(ctx: Any, drawing: _Drawing, *tensors: Tensor | None) -> tuple[Tensor, ...]:
        wants = dict(zip(_NAMES, ctx.needs_input_grad[1:], strict=True))
        outputs = drawing.draw(wants)
        ctx.mark_non_differentiable(outputs[5])
        ctx.set_materialize_grads(False)
        ctx.drawing, ctx.wants = drawing, wants
        # Saved for the sake of autograd's check against changes in place: the state reads these.
        ctx.save_for_backward(*tensors)
        return outputs

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, *upstream: Tensor | None) -> tuple[Tensor | None, ...]:
        tensors = ctx.saved_tensors
        *pictures, _, per_pixel = upstream
        grads = ctx.drawing.undraw((*pictures, per_pixel), ctx.wants)
        given: list[Tensor | None] = [None]
        for name, tensor in zip(_NAMES, tensors, strict=True):
            if name not in grads:
                given.append(None)
                continue
            grad = grads[name]
            if name == "hook" and tensor.shape[1] != 3:
                grad = torch.nn.functional.pad(grad, (0, tensor.shape[1] - 3))
            given.append(grad.to(tensor.device, tensor.dtype))
        return tuple(given)


class CpuEngine:
    """Rasterizes with the compiled library; results are the same, to the bit, for any threads.

    Args:
        library: the build to use; None for the best one on this machine.

    Attributes:
        workspace: its reusable memory.
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
        view, splats = inputs.view, inputs.splats
        others = {
            "hook": inputs.means2d_hook,
            "thresholds": thresholds,
            "background": view.background,
        }
        tensors = {name: others.get(name, getattr(splats, name, None)) for name in _NAMES}
        arrays = native_arrays(inputs, thresholds)
        drawing = _Drawing(inputs, self.library, self.workspace, arrays)
        outputs = _Rasterize.apply(  # type: ignore[no-untyped-call]
            drawing, *(tensors[name] for name in _NAMES)
        )
        image, invdepth, alpha, features, surface, radii, per_pixel = outputs
        device, pixels = splats.device, view.width * view.height
        return RasterOutputs(
            image=image.to(device),
            radii=radii.to(device),
            invdepth=invdepth.to(device),
            alpha=alpha.to(device),
            fragments_per_pixel=per_pixel.to(device),
            evaluated_per_pixel=drawing.evaluated / pixels,
            entries_per_pixel=drawing.entries / pixels,
            features=None if splats.features is None else features.to(device),
            stages=drawing.stages,
            surface=surface.to(device) if len(surface) else None,
            **{name: tensor.to(device) for name, tensor in drawing.found.items()},
        )


def _channels(features: Tensor | None) -> int:
    return 0 if features is None else features.shape[1]
