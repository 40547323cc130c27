"""What calls of compiled code share: tensors as arrays, inputs as a struct, gradients, errors."""

from __future__ import annotations

import ctypes
import math
from collections.abc import Callable, Collection, Mapping
from dataclasses import replace
from typing import Any, Final, get_args

import torch
from torch import Tensor
from torch.autograd.function import once_differentiable

from fragprune_plugins.constants import THREADS_MAX
from fragprune_plugins.engines.cpu import binding
from fragprune_plugins.errors import EngineError
from fragprune_plugins.types import Compensation, RasterInputs, Splats

Wanted = frozenset[str]  # inputs that gradients are wanted of, as fragprune_input_grads names them
_COMPENSATIONS: Final = get_args(Compensation)  # in the order of enum fragprune_compensation

_SCALARS: Final = (
    *("width", "height", "tan_fov_x", "tan_fov_y", "scale_modifier", "dilation", "near"),
    *("alpha_max", "cap_gradient", "absolute_gradient"),
)
"""Of fragprune_inputs: those of a view and of ``RasterInputs`` that have the same names there."""

SMALL = 1 << 16  # bytes below which the C library has memory at hand itself


def plain(
    tensor: Tensor, where: torch.device | str = "cpu", dtype: torch.dtype = torch.float32
) -> Tensor:
    """The tensor's values, contiguous on a device, as 4-byte numbers."""
    return tensor.detach().to(where, dtype).contiguous()


def empty(workspace: binding.Workspace, *shape: int, dtype: torch.dtype = torch.float32) -> Tensor:
    """Like torch.empty for 4-byte numbers, but large tensors reuse memory of a workspace.

    Fresh memory is slow: the system clears it page by page, which takes longer than filling it.
    """
    size = 4 * math.prod(shape)
    if size < SMALL:
        return torch.empty(shape, dtype=dtype, device="cpu")
    return torch.frombuffer(workspace.take(size), dtype=dtype).view(shape)


def run(library: binding.Library, function: str, *arguments: Any) -> None:
    """Call a function of the C interface, structs by reference; EngineError if it refuses them."""
    error = binding.Error()
    passed = (
        ctypes.byref(each) if isinstance(each, ctypes.Structure) else each
        for each in (*arguments, error)
    )
    status = getattr(library.calls, f"fragprune_{function}")(*passed)
    if status == binding.OK:
        return
    text = error.message.decode(errors="replace")
    if status == binding.OUT_OF_MEMORY:
        raise MemoryError(f"fragprune's cpu engine: {text}")
    remedy = "Check the camera and the Gaussians."
    raise EngineError("engine 'cpu'", text, "inputs it can draw", remedy)


def native_arrays(
    inputs: RasterInputs, thresholds: Tensor | None, where: torch.device | str = "cpu"
) -> dict[str, Tensor]:
    """The tensors that the engine reads, after ``plain``, by their names in fragprune_inputs."""
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
    """Fill the struct fragprune_inputs. It points into ``native_arrays``, which must outlive it.

    ``counts`` and ``scores`` are ignored: they choose outputs. ``widen``: thresholds learn.
    """
    splats, given = inputs.splats, vars(inputs.view) | vars(inputs)
    return binding.Inputs(
        **{name: given[name] for name in _SCALARS},
        threads=threads,
        stop=inputs.stop or 0.0,
        compensation=_COMPENSATIONS.index(inputs.compensation),
        sh_degree=splats.sh_degree if isinstance(splats, Splats) else 0,
        sh_coefficients=sum(_second_length(arrays.get(name)) for name in ("sh", "sh_rest")),
        feature_count=_second_length(arrays.get("features")),
        widen=widen,
        flat=splats.flat,
        soft=inputs.rim == "soft",
        count=len(splats),
        lengths=binding.Lengths(**{name: array.numel() for name, array in arrays.items()}),
        workspace=workspace,
        **arrays,
    )


def new_outputs(
    inputs: RasterInputs, new: Callable[..., Tensor], planes: Collection[str]
) -> dict[str, Tensor]:
    """Room for what is drawn by any engine, by the names of fragprune_outputs, of ``planes`` these.

    ``new`` makes a tensor of a shape, float32 unless it is given a ``dtype``.
    """
    n, size, whole = len(inputs.splats), (inputs.view.height, inputs.view.width), torch.int32
    made = {"image": new(3, *size), "radii": new(n, dtype=whole)}
    made |= {name: new(int(name in planes), *size) for name in ("invdepth", "alpha")}
    if inputs.splats.features is not None:
        made["features"] = new(inputs.splats.features.shape[1], *size)
    if inputs.counts:
        made["fragments"] = new(*size, dtype=whole)
        made["fragments_per_gaussian"] = new(n, dtype=whole)
    if inputs.scores:
        made["wins_per_gaussian"] = new(n, dtype=whole)
        made["winners"] = new(*size, dtype=whole)
    return made


def with_joined_sh(splats: Splats) -> Splats:
    """The same with all coefficients in ``sh``."""
    if splats.sh is None or splats.sh_rest is None:
        return splats
    return replace(splats, sh=torch.cat([splats.sh, splats.sh_rest], dim=1), sh_rest=None)


def native_threads() -> int:
    """The number of threads that torch uses, at most the bound of the C interface."""
    return min(torch.get_num_threads(), THREADS_MAX)


def _second_length(array: Tensor | None) -> int:
    return 0 if array is None else array.shape[1]


# ---- gradients ---------------------------------------------------------------------------------

_LEARNABLE = tuple(name for name, *_ in binding.InputGrads._fields_)
_DIFFERENTIABLE = ("image", "invdepth", "alpha", "features", "surface", "fragments_per_pixel")
_FELT_BY = dict.fromkeys(_DIFFERENTIABLE, frozenset(_LEARNABLE))

Draw = Callable[[Wanted], Mapping[str, Tensor]]  # a forward pass: the outputs by name

Undraw = Callable[[Wanted, dict[str, Tensor]], dict[str, Tensor]]
"""A backward pass, from gradients of outputs to gradients of the wanted inputs, by name."""


def with_gradients(
    inputs: RasterInputs, thresholds: Tensor | None, draw: Draw, undraw: Undraw
) -> dict[str, Any]:
    """Draw in torch's graph, tensors by their names in ``RasterOutputs``."""
    given = vars(inputs.splats) | {"hook": inputs.means2d_hook, "thresholds": thresholds}
    given["background"] = inputs.view.background
    tensors = {name: given[name] for name in _LEARNABLE if given.get(name) is not None}
    return in_graph(tensors, draw, undraw, _FELT_BY)


def in_graph(
    tensors: Mapping[str, Tensor], draw: Draw, undraw: Undraw, felt_by: Mapping[str, Wanted]
) -> dict[str, Tensor]:
    """Run compiled code in torch's graph, where it can be differentiated once; gives its outputs.

    Args:
        tensors: what may want gradients, by name; on any device and of any floating type.
        felt_by: by an output's name, the inputs that it depends on. One that depends on none whose
            gradients are wanted gets no gradient.
    """
    if not torch.is_grad_enabled():  # the function would be told that parameters want theirs
        tensors = {name: each.detach() for name, each in tensors.items()}
    made: list[str] = []  # the outputs' names
    outputs = _Compiled.apply((draw, undraw, felt_by), made, tuple(tensors), *tensors.values())  # type: ignore[no-untyped-call]
    return dict(zip(made, outputs, strict=True))


class _Compiled(torch.autograd.Function):
    """The autograd function of ``in_graph``."""

    @staticmethod
    def forward(
        ctx: Any, code: Any, made: list[str], names: tuple[str, ...], *tensors: Tensor
    ) -> tuple[Tensor, ...]:
        draw, ctx.undraw, felt_by = code
        needed = zip(names, ctx.needs_input_grad[3:], strict=True)
        wanted = frozenset(name for name, needs in needed if needs)
        outputs = draw(wanted)
        made.extend(outputs)
        constant = [each for name, each in outputs.items() if not wanted & felt_by.get(name, set())]
        ctx.mark_non_differentiable(*constant)
        ctx.set_materialize_grads(False)
        ctx.wanted, ctx.names, ctx.made = wanted, names, made
        # Saved for the sake of autograd's check against changes in place: ``undraw`` reads these.
        ctx.save_for_backward(*tensors)
        return tuple(outputs.values())

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, *upstream: Tensor | None) -> tuple[Tensor | None, ...]:
        tensors = ctx.saved_tensors
        by = zip(ctx.made, upstream, strict=True)
        grads = ctx.undraw(ctx.wanted, {name: grad for name, grad in by if grad is not None})
        given: list[Tensor | None] = [None, None, None]
        for name, tensor in zip(ctx.names, tensors, strict=True):
            grad = grads.get(name)
            if name == "hook" and grad is not None and tensor.shape[1] != 3:  # wider, or narrower
                grad = torch.nn.functional.pad(grad, (0, tensor.shape[1] - 3))
            given.append(None if grad is None else grad.to(tensor.device, tensor.dtype))
        return tuple(given)
