"""The rasterizer on a GPU as an engine: tensors in, tensors out, every gradient."""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING, Any

import torch
from torch.autograd.function import once_differentiable

from fragprune_plugins.engines.calling import with_joined_sh
from fragprune_plugins.engines.cuda.driver import Driver
from fragprune_plugins.engines.cuda.frame import (
    Device,
    Drawing,
    Drawn,
    Wanted,
    learnable,
)
from fragprune_plugins.errors import EngineError, InputError
from fragprune_plugins.types import RasterOutputs, Splats

if TYPE_CHECKING:
    from torch import Tensor

    from fragprune_plugins.types import RasterInputs

_FIRST_CAPACITY = 1 << 20
"""Entries of the tiles' lists that there is room for before any frame has told."""


class _Rasterize(torch.autograd.Function):
    """The autograd function of a rasterization."""

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
    """Rasterizes on a GPU with kernels that are compiled at first use.

    Args:
        device: runs the kernels; None for the GPU of the tensors.
        deterministic: make gradients the same to the bit in each run, at the cost of time and
            memory; None follows torch.use_deterministic_algorithms. Images are always the same.

    Raises:
        EngineError: kernels cannot be compiled or run here; the message says why.
    """

    name = "cuda"

    def __init__(self, device: Device | None = None, *, deterministic: bool | None = None) -> None:
        if device is None:
            device = Driver()
        self.device = device
        self._deterministic = deterministic
        self._capacity = _FIRST_CAPACITY

    def rasterize(self, inputs: RasterInputs, thresholds: Tensor | None) -> RasterOutputs:
        """Draw the splats; thresholds is (N,) falloff in (0, 1), or None for no truncation.

        Raises:
            InputError: the Gaussians are not on a GPU, there is not one threshold for each, or the
                rim is soft.
            EngineError: they are surfels, for which there are no kernels.
        """
        inputs.check_thresholds(thresholds)
        if isinstance(inputs.splats, Splats) and inputs.splats.flat:
            raise EngineError(
                "engine 'cuda'",
                "surfels (2 scales each)",
                "3D Gaussians: there are no kernels for surfels",
                "Run on the CPU (--device cpu), or draw small pictures with --engine reference.",
            )
        if inputs.rim != "hard" and thresholds is not None:
            raise InputError(
                "engine 'cuda'",
                f"a {inputs.rim} rim",
                "a hard rim: there are no kernels for another",
                "Run on the CPU (--device cpu), or draw it hard: replace(inputs, rim='hard').",
            )
        self.expect_on_device(inputs.splats.device)
        if isinstance(inputs.splats, Splats):
            inputs = replace(inputs, splats=with_joined_sh(inputs.splats))
        drawing = Drawing(self.device, inputs, thresholds)
        tensors = {
            **learnable(inputs),
            **({} if thresholds is None else {"thresholds": thresholds}),
        }
        drawn = _Rasterize.apply(  # type: ignore[no-untyped-call]
            self, drawing, tuple(tensors), *tensors.values()
        )
        pixels = inputs.view.width * inputs.view.height
        return RasterOutputs(
            evaluated_per_pixel=drawing.evaluated / pixels,
            entries_per_pixel=drawing.entries / pixels,
            **Drawn(*drawn)._asdict(),
        )

    def expect_on_device(self, where: torch.device) -> None:
        """Raise InputError unless Gaussians there can be drawn."""
        if where.type != self.device.kind:
            raise InputError(
                "engine 'cuda'",
                f"Gaussians on {where}",
                f"tensors on a {self.device.kind} device",
                "Move the Gaussians, or use the engine 'cpu'.",
            )

    def draw(self, drawing: Drawing, wanted: Wanted) -> Drawn:
        """Run the forward pass; repeat it with more room if the lists did not fit."""
        deterministic = self._deterministic
        if deterministic is None:
            deterministic = torch.are_deterministic_algorithms_enabled()
        drawn = drawing.draw(self._capacity, wanted, deterministic=deterministic)
        if (entries := drawing.read()) > self._capacity:
            self._capacity = entries + entries // 4
            drawn = drawing.draw(self._capacity, wanted, deterministic=deterministic)
            drawing.read()
        return drawn
