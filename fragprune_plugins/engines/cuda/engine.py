"""The rasterizer on a GPU as an engine: tensors in, tensors out, every gradient."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import torch
from torch.autograd.function import once_differentiable

from fragprune_plugins.engines.cuda.frame import (
    Device,
    Drawing,
    Drawn,
    KernelBlade,
    Wanted,
    learnable,
)
from fragprune_plugins.engines.slicing import slice_by
from fragprune_plugins.errors import EngineError, InputError
from fragprune_plugins.types import RasterOutputs

if TYPE_CHECKING:
    from torch import Tensor

    from fragprune_plugins.types import (
        Footprints,
        Moment,
        RasterInputs,
        Sliced,
        SpacetimeSplats,
        Splats,
    )

_FIRST_CAPACITY = 1 << 20
"""Entries of the tiles' lists that there is room for before any frame has told."""


class _Rasterize(torch.autograd.Function):
    """The engine's seam to autograd."""

    @staticmethod
    def forward(
        ctx: Any, engine: CudaEngine, drawing: Drawing, names: tuple[str, ...], *tensors: Tensor
    ) -> tuple[Tensor | None, ...]:
        wanted = frozenset(
            n for n, needs in zip(names, ctx.needs_input_grad[3:], strict=True) if needs
        )
        drawn = engine.draw(drawing, wanted)
        ctx.mark_non_differentiable(*(each for each in drawn[5:] if each is not None))
        ctx.set_materialize_grads(False)
        ctx.drawing, ctx.names, ctx.wanted = drawing, names, wanted
        # Saved for the sake of autograd's check against changes in place: the drawing reads these.
        ctx.save_for_backward(*tensors)
        return drawn

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, *upstream: Tensor | None) -> tuple[Tensor | None, ...]:
        tensors = ctx.saved_tensors
        grads = ctx.drawing.undraw(ctx.wanted, *upstream[:5])
        given: list[Tensor | None] = [None, None, None]
        for name, tensor in zip(ctx.names, tensors, strict=True):
            grad = grads.get(name)
            if name == "hook" and grad is not None:  # hooks may be wider or narrower than ours
                grad = torch.nn.functional.pad(grad, (0, tensor.shape[1] - 3))
            given.append(None if grad is None else grad.to(tensor.device, tensor.dtype))
        return tuple(given)


class CudaEngine:
    """Rasterizes on a GPU, by kernels that are compiled when they are first used.

    Args:
        device: runs the kernels; the GPU that the tensors live on when None.
        deterministic: gradients are the same to the bit in each run, for more time and memory;
            what torch.use_deterministic_algorithms says when None. Images always are.
        packed: where no gradients are wanted, keep projected Gaussians in 32 bytes instead of 48:
            colours and inverse depths as half precision, opacities and cutoffs with 16 bits. A
            pixel is off by up to 2^-11 of the largest colour, and by a fragment that lies on a cut.

    Raises:
        EngineError: kernels cannot be compiled or run here; the message says why.
    """

    name = "cuda"

    def __init__(
        self,
        device: Device | None = None,
        *,
        deterministic: bool | None = None,
        packed: bool = False,
    ) -> None:
        if device is None:
            from fragprune_plugins.engines.cuda.driver import Driver

            device = Driver()
        self._device = device
        self._deterministic, self._packed = deterministic, packed
        self._capacity = _FIRST_CAPACITY
        self._captured: list[tuple[Drawing, int]] = []

    def rasterize(self, inputs: RasterInputs, thresholds: Tensor | None) -> RasterOutputs:
        """Draw the splats; thresholds is (N,) falloff in (0, 1), or None for no truncation.

        Raises:
            InputError: the Gaussians are not on a GPU, or thresholds are not one for each.
        """
        inputs.check_thresholds(thresholds)
        self._on_device(inputs.splats)
        drawing = Drawing(self._device, inputs, thresholds)
        tensors = {
            **learnable(inputs),
            **({} if thresholds is None else {"thresholds": thresholds}),
        }
        drawn = _Rasterize.apply(  # type: ignore[no-untyped-call]
            self, drawing, tuple(tensors), *tensors.values()
        )
        return RasterOutputs(
            evaluated_per_pixel=drawing.evaluated / (inputs.view.width * inputs.view.height),
            **Drawn(*drawn)._asdict(),
        )

    def slice(self, splats: SpacetimeSplats, moment: Moment) -> Sliced:
        """Cut Gaussians in space and time at a moment.

        Raises:
            InputError: the Gaussians are not on a GPU.
        """
        return slice_by(KernelBlade(self._device, self._on_device(splats)), splats, moment)

    def _on_device(self, splats: Splats | Footprints | SpacetimeSplats) -> torch.device:
        where = splats.device
        if where.type != self._device.kind:
            raise InputError(
                "engine 'cuda'",
                f"Gaussians on {where}",
                f"tensors on a {self._device.kind} device",
                "Move the Gaussians, or use the engine 'cpu'.",
            )
        return where

    def draw(self, drawing: Drawing, wanted: Wanted) -> Drawn:
        """The forward pass, again with more room when the lists did not fit."""
        deterministic = self._deterministic
        if deterministic is None:
            deterministic = torch.are_deterministic_algorithms_enabled()
        how = {"deterministic": deterministic, "packed": self._packed}
        drawn = drawing.draw(self._capacity, wanted, **how)
        if self._device.capturing():
            self._captured.append((drawing, self._capacity))
        elif (entries := drawing.read()) > self._capacity:
            self._capacity = entries + entries // 4
            drawn = drawing.draw(self._capacity, wanted, **how)
            drawing.read()
        return drawn

    def check(self) -> None:
        """Look at the frames captured into graphs, after a replay; waits for the GPU.

        Raises:
            EngineError: the last replay of one found no room for its lists: its picture is void.
        """
        for drawing, capacity in self._captured:
            entries = drawing.read()
            if entries > capacity:
                self._capacity = max(self._capacity, entries + entries // 4)
                raise EngineError(
                    "engine 'cuda'",
                    f"{entries} entries in a captured frame's lists",
                    f"at most {capacity}, what there was room for",
                    "Capture the graph again: there is more room now.",
                )
