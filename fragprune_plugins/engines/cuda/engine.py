"""The rasterizer on a GPU as an engine: tensors in, tensors out, every gradient."""

from __future__ import annotations

from dataclasses import replace
from functools import cache, partial

import torch
from torch import Tensor

from fragprune_plugins.engines.calling import Wanted, with_gradients, with_joined_sh
from fragprune_plugins.engines.cuda.driver import Driver, missing
from fragprune_plugins.engines.cuda.frame import ENTRIES_MAX, Device, Drawing
from fragprune_plugins.errors import EngineError, InputError
from fragprune_plugins.types import RasterInputs, RasterOutputs, Splats


@cache
def _driver(why_not: str | None) -> Driver:
    """The driver of this process while ``missing`` says the same: it keeps what it has loaded."""
    return Driver()


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
    capacity = 1 << 20  # entries of the tiles' lists that there is room for; grows with frames

    def __init__(self, device: Device | None = None, *, deterministic: bool | None = None) -> None:
        self.device = _driver(missing()) if device is None else device
        self._deterministic = deterministic

    def rasterize(self, inputs: RasterInputs, thresholds: Tensor | None) -> RasterOutputs:
        """Draw the splats; thresholds is (N,) falloff in (0, 1), or None for no truncation.

        Raises:
            InputError: the Gaussians are not on a GPU, there is not one threshold for each, or the
                rim is soft.
            EngineError: they are surfels, for which there are no kernels.
        """
        inputs.check_thresholds(thresholds)
        if inputs.splats.flat:
            expected = "3D Gaussians: there are no kernels for surfels"
            remedy = "Run on the CPU (--device cpu), or draw it small with --engine reference."
            raise EngineError("engine 'cuda'", "surfels (2 scales each)", expected, remedy)
        if inputs.rim != "hard" and thresholds is not None:
            expected = "a hard rim: there are no kernels for another"
            remedy = "Run on the CPU (--device cpu), or draw it hard: replace(inputs, rim='hard')."
            raise InputError("engine 'cuda'", f"a {inputs.rim} rim", expected, remedy)
        self.expect_on_device(inputs.splats.device)
        if isinstance(inputs.splats, Splats):
            inputs = replace(inputs, splats=with_joined_sh(inputs.splats))
        drawing = Drawing(self.device, inputs, thresholds)
        drawn = with_gradients(inputs, thresholds, partial(self.draw, drawing), drawing.undraw)
        pixels = inputs.view.width * inputs.view.height
        return RasterOutputs(
            evaluated_per_pixel=drawing.evaluated / pixels,
            entries_per_pixel=drawing.entries / pixels,
            **drawn,
        )

    def expect_on_device(self, where: torch.device) -> None:
        """Raise InputError unless Gaussians there can be drawn."""
        if where.type != self.device.kind:
            expected = f"tensors on a {self.device.kind} device"
            remedy = "Move the Gaussians, or use the engine 'cpu'."
            raise InputError("engine 'cuda'", f"Gaussians on {where}", expected, remedy)

    def draw(self, drawing: Drawing, wanted: Wanted) -> dict[str, Tensor]:
        """Run the forward pass; repeat it with more room if the lists did not fit."""
        deterministic = self._deterministic
        if deterministic is None:
            deterministic = torch.are_deterministic_algorithms_enabled()
        while True:
            drawn = drawing.draw(room := self.capacity, wanted, deterministic=deterministic)
            if (entries := drawing.read()) <= room:  # another thread may have made more meanwhile
                return drawn
            self.capacity = min(entries + entries // 4, ENTRIES_MAX)
