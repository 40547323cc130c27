"""What calls of compiled code share: tensors as arrays, the inputs as a struct, memory, errors."""

from __future__ import annotations

import math
from dataclasses import replace
from typing import TYPE_CHECKING, Final, get_args

import torch

from fragprune_plugins.constants import THREADS_MAX
from fragprune_plugins.engines.cpu import binding
from fragprune_plugins.errors import EngineError
from fragprune_plugins.types import Compensation, Splats

if TYPE_CHECKING:
    from torch import Tensor

    from fragprune_plugins.types import RasterInputs

_COMPENSATIONS: Final = get_args(Compensation)
"""In the order of enum fragprune_compensation."""

SMALL = 1 << 16
"""Bytes below which the C library has memory at hand itself."""


def plain(
    tensor: Tensor, where: torch.device | str = "cpu", dtype: torch.dtype = torch.float32
) -> Tensor:
    """The tensor's values, contiguous on a device, as 4-byte numbers."""
    return tensor.detach().to(where, dtype).contiguous()


def address(tensor: Tensor | None) -> int | None:
    """The address of a tensor's first number; None for no tensor or an empty one."""
    return None if tensor is None or tensor.numel() == 0 else tensor.data_ptr()


def empty(workspace: binding.Workspace, *shape: int, dtype: torch.dtype = torch.float32) -> Tensor:
    """Like torch.empty for 4-byte numbers, but large tensors reuse memory of a workspace.

    Fresh memory is slow: the system clears it page by page, which takes longer than filling it.
    """
    size = 4 * math.prod(shape)
    if size < SMALL:
        return torch.empty(shape, dtype=dtype)
    return torch.frombuffer(workspace.take(size), dtype=dtype).view(shape)


def expect_ok(status: int, error: binding.Error) -> None:
    """Raise what a call's status says.

    Raises:
        MemoryError: there is not enough memory.
        EngineError: the inputs were refused.
    """
    if status == binding.OK:
        return
    text = error.message.decode(errors="replace")
    if status == binding.OUT_OF_MEMORY:
        raise MemoryError(f"fragprune's cpu engine: {text}")
    raise EngineError(
        "engine 'cpu'", text, "inputs it can draw", "Check the camera and the Gaussians."
    )


def native_arrays(
    inputs: RasterInputs, thresholds: Tensor | None, where: torch.device | str = "cpu"
) -> dict[str, Tensor]:
    """The tensors that the engine reads, after ``plain``, by their names in fragprune_inputs.

    Args:
        inputs: the rasterization; the values of ``means2d_hook`` are not used.
        thresholds: (N,) or None, already checked by ``inputs.check_thresholds``.
    """
    given = vars(inputs.view) | vars(inputs.splats) | vars(inputs) | {"thresholds": thresholds}
    return {
        name: plain(given[name], where, torch.int32 if name == "tiles" else torch.float32)
        for name in binding.ARRAYS
        if given.get(name) is not None
    }


def native_inputs(
    inputs: RasterInputs,
    arrays: dict[str, Tensor],
    *,
    widen: bool,
    threads: int = 1,
    workspace: int | None = None,
) -> binding.Inputs:
    """Fill the struct fragprune_inputs. It points into the arrays, which must outlive it.

    Args:
        inputs: the rasterization. ``counts`` and ``scores`` are ignored: they choose outputs.
        arrays: the result of ``native_arrays``.
        widen: thresholds will want a gradient.
    """
    view, splats = inputs.view, inputs.splats
    return binding.Inputs(
        threads=threads,
        width=view.width,
        height=view.height,
        tan_fov_x=view.tan_fov_x,
        tan_fov_y=view.tan_fov_y,
        scale_modifier=inputs.scale_modifier,
        dilation=inputs.dilation,
        near=inputs.near,
        alpha_max=inputs.alpha_max,
        stop=inputs.stop or 0.0,
        compensation=_COMPENSATIONS.index(inputs.compensation),
        cap_gradient=inputs.cap_gradient,
        absolute_gradient=inputs.absolute_gradient,
        sh_degree=splats.sh_degree if isinstance(splats, Splats) else 0,
        sh_coefficients=sum(_second_length(arrays.get(name)) for name in ("sh", "sh_rest")),
        feature_count=_second_length(arrays.get("features")),
        widen=widen,
        flat=isinstance(splats, Splats) and splats.flat,
        soft=inputs.rim == "soft",
        count=len(splats),
        lengths=native_lengths(arrays),
        workspace=workspace,
        **{name: address(array) for name, array in arrays.items()},
    )


def with_joined_sh(splats: Splats) -> Splats:
    """The same with all coefficients in ``sh``."""
    if splats.sh is None or splats.sh_rest is None:
        return splats
    return replace(splats, sh=torch.cat([splats.sh, splats.sh_rest], dim=1), sh_rest=None)


def native_lengths(arrays: dict[str, Tensor]) -> binding.Lengths:
    """Fill the struct fragprune_lengths for arrays given by name."""
    return binding.Lengths(**{name: array.numel() for name, array in arrays.items()})


def native_threads() -> int:
    """The number of threads that torch uses, at most the bound of the C interface."""
    return min(torch.get_num_threads(), THREADS_MAX)


def _second_length(array: Tensor | None) -> int:
    return 0 if array is None else array.shape[1]
