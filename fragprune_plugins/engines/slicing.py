"""Cuts Gaussians in space and time at a moment with compiled code, under autograd.

Each Gaussian is cut by itself. So the cpu engine and the cuda engine share everything but the call
itself, a ``Blade``. Between the two passes only the inputs are kept.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, Protocol

import torch
from torch.autograd.function import once_differentiable

from fragprune_plugins.engines.arrays import address, plain
from fragprune_plugins.engines.cpu import binding
from fragprune_plugins.engines.inputs import native_lengths, native_threads
from fragprune_plugins.errors import InputError
from fragprune_plugins.types import Moment, Sliced, SpacetimeSplats

if TYPE_CHECKING:
    from torch import Tensor

# The differentiable inputs, in the order in which the autograd function takes them.
_NAMES = (
    "means",
    "opacities",
    "times",
    "scales",
    "scales_t",
    "rotations",
    "rotations_r",
    "cov3d",
    "sh",
)


_SHAPE = frozenset(("scales", "scales_t", "rotations", "rotations_r"))

# The inputs that affect each output. If none of them needs a gradient, an engine skips the output's
# part of the backward pass; in fine-tuning that is most of it.
_FELT_BY = {
    "means": _SHAPE | {"means", "times"},
    "cov3d": _SHAPE | {"cov3d"},
    "opacities": _SHAPE | {"opacities", "times"},
    "colors": _SHAPE | {"sh", "means", "times"},
}


class Blade(Protocol):
    """The compiled functions that cut Gaussians, and the device they run on."""

    @property
    def where(self) -> torch.device:
        """The device on which the tensors must be."""

    def empty(self, *shape: int) -> Tensor:
        """An uninitialised float32 tensor of this shape on the device."""

    def slice(self, given: binding.Spacetime, to: binding.Sliced) -> None:
        """Call fragprune_slice."""

    def unslice(
        self, given: binding.Spacetime, by: binding.Sliced, to: binding.SpacetimeGrads
    ) -> None:
        """Call fragprune_unslice."""


@dataclass
class _Cut:
    """The inputs of one cut that are not differentiable.

    Attributes:
        blade: the engine's compiled functions.
        splats: the engine's input.
        moment: the engine's input.
        arrays: the tensors that compiled code reads.
    """

    blade: Blade
    splats: SpacetimeSplats
    moment: Moment
    arrays: dict[str, Tensor]

    def given(self) -> binding.Spacetime:
        """The C struct of the inputs; it points into ``arrays``."""
        moment, sh = self.moment, self.splats.sh
        return binding.Spacetime(
            threads=native_threads(),
            timestamp=moment.timestamp,
            duration=moment.duration,
            prefilter_var=moment.prefilter_var,
            scale_modifier=moment.scale_modifier,
            sh_degree=self.splats.sh_degree,
            sh_degree_t=-1 if moment.sh_degree_t is None else moment.sh_degree_t,
            sh_coefficients=0 if sh is None else sh.shape[1],
            count=len(self.splats),
            lengths=native_lengths(self.arrays),
            **{name: address(array) for name, array in self.arrays.items()},
        )


class _Slice(torch.autograd.Function):
    """The autograd function of a cut."""

    @staticmethod
    def forward(ctx: Any, cut: _Cut, *tensors: Tensor | None) -> tuple[Tensor | None, ...]:
        n, blade = len(cut.splats), cut.blade
        outputs = {
            "means": blade.empty(n, 3),
            "cov3d": blade.empty(n, 6),
            "opacities": blade.empty(n),
            "colors": blade.empty(n, 3) if "sh" in cut.arrays else None,
        }
        present = torch.empty(n, dtype=torch.bool, device=blade.where)
        addresses = {name: address(output) for name, output in outputs.items()}
        blade.slice(cut.given(), binding.Sliced(present=address(present), **addresses))
        wanted = {n for n, needs in zip(_NAMES, ctx.needs_input_grad[1:], strict=True) if needs}
        idle = [o for name, o in outputs.items() if o is not None and not wanted & _FELT_BY[name]]
        ctx.mark_non_differentiable(present, *idle)
        ctx.set_materialize_grads(False)
        ctx.cut, ctx.present = cut, present
        # Saved for the sake of autograd's check against changes in place: the cut reads these.
        ctx.save_for_backward(*tensors)
        return *outputs.values(), present

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, *upstream: Tensor | None) -> tuple[Tensor | None, ...]:
        cut, tensors = ctx.cut, ctx.saved_tensors
        by = [None if g is None else plain(g, cut.blade.where) for g in upstream[:4]]
        wanted = [n for n, needs in zip(_NAMES, ctx.needs_input_grad[1:], strict=True) if needs]
        grads = {name: cut.blade.empty(*cut.arrays[name].shape) for name in wanted}
        cut.blade.unslice(
            cut.given(),
            binding.Sliced(
                present=address(ctx.present),
                **{name: address(g) for name, g in zip(_FELT_BY, by, strict=True)},
            ),
            binding.SpacetimeGrads(**{name: address(grad) for name, grad in grads.items()}),
        )
        given: list[Tensor | None] = [None]
        for name, tensor in zip(_NAMES, tensors, strict=True):
            grad = grads.get(name)
            given.append(None if grad is None else grad.to(tensor.device, tensor.dtype))
        return tuple(given)


def slice_by(blade: Blade, splats: SpacetimeSplats, moment: Moment) -> Sliced:
    """Cut the Gaussians at the moment; differentiable in every tensor of the splats.

    Raises:
        InputError: there are fewer SH coefficients than the moment's cosines need.
    """
    check_harmonics(splats, moment)
    tensors = {name: getattr(splats, name) for name in _NAMES}
    read = {**tensors, "campos": moment.campos}
    arrays = {name: plain(t, blade.where) for name, t in read.items() if t is not None}
    cut = _Cut(blade, splats, moment, arrays)
    means, cov3d, opacities, colors, present = _Slice.apply(  # type: ignore[no-untyped-call]
        cut, *tensors.values()
    )
    device = splats.device
    return Sliced(
        means=means.to(device),
        cov3d=cov3d.to(device),
        opacities=opacities.to(device),
        present=present.to(device),
        colors=None if colors is None else colors.to(device),
    )


def check_harmonics(splats: SpacetimeSplats, moment: Moment) -> None:
    """Raise InputError if coefficients or times for the cosines in use are missing."""
    orders = moment.sh_degree_t if splats.sh is not None and splats.sh_degree == 3 else 0
    if not orders:
        return
    assert splats.sh is not None
    if splats.sh.shape[1] < 16 * (1 + orders) or splats.times is None:
        raise InputError(
            "SpacetimeSplats.sh",
            f"{splats.sh.shape[1]} coefficients, times {'' if splats.times is not None else 'not '}"
            "given",
            f"times, and at least {16 * (1 + orders)} for {orders} cosines",
            "Use fewer cosines or pass all coefficients.",
        )
