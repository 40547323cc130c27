"""Cuts Gaussians in space and time at a moment, under autograd: ``slice_at``.

Each Gaussian is cut by itself. So the cpu engine and the cuda engine share everything but the call
itself, ``SliceKernels``. Between the two passes only the inputs are kept.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import cache, partial
from typing import TYPE_CHECKING, Any, Literal

import torch

from fragprune_plugins.engines import create_engine
from fragprune_plugins.engines.calling import Wanted, empty, in_graph, native_threads, plain, run
from fragprune_plugins.engines.cpu import binding
from fragprune_plugins.engines.cpu.engine import CpuEngine
from fragprune_plugins.engines.cuda.engine import CudaEngine
from fragprune_plugins.engines.cuda.frame import Device, blocks_of, launch
from fragprune_plugins.engines.reference import ReferenceEngine
from fragprune_plugins.errors import EngineError, InputError
from fragprune_plugins.slicing import structs
from fragprune_plugins.slicing.splats import Moment, Sliced, SpacetimeSplats
from reference_renderer import SpacetimeGaussians, slice_gaussians

if TYPE_CHECKING:
    from torch import Tensor

    from fragprune_plugins.engines import Engine


def slice_at(splats: SpacetimeSplats, moment: Moment, *, engine: str | Engine = "auto") -> Sliced:
    """Cut Gaussians in space and time at a moment: 3D Gaussians remain. Differentiable.

    Gradients are those of RT-4DGS, whose hand-written kernels differ from the true derivatives.
    Without ``rotations_r`` the marginal has no gradient. Colours are evaluated with directions to
    the stored means, but differentiated with directions to the moved means. If colours depend on
    time, the second coefficient receives the first one's gradient, and the times receive only the
    gradient of the highest cosine, with the opposite sign.

    Args:
        engine: a name for ``create_engine``, or an engine. If it is not ours, the fastest of our
            engines on the device cuts.

    Raises:
        InputError: there are fewer SH coefficients than the moment's cosines need, or the Gaussians
            are not where the engine reads them.
        EngineError: there is no such engine here, or a GPU cuts wrongly.
    """
    check_harmonics(splats, moment)
    if not isinstance(engine, CpuEngine | CudaEngine | ReferenceEngine):
        engine = create_engine(engine if isinstance(engine, str) else "auto", splats.device)
    if isinstance(engine, CpuEngine):
        return slice_by(of_cpu(engine), splats, moment)
    if isinstance(engine, CudaEngine):
        engine.expect_on_device(splats.device)
        expect_right(engine.device, splats.device)
        return slice_by(of_cuda(engine.device, splats.device), splats, moment)
    return slice_by_oracle(splats, moment)


def slice_by_oracle(splats: SpacetimeSplats, moment: Moment) -> Sliced:
    """Cut with plain torch, in the precision of the tensors."""
    return Sliced(**vars(slice_gaussians(SpacetimeGaussians(**vars(splats)), **vars(moment))))


def check_harmonics(splats: SpacetimeSplats, moment: Moment) -> None:
    """Raise InputError if coefficients or times for the cosines in use are missing."""
    orders = moment.sh_degree_t if splats.sh is not None and splats.sh_degree == 3 else 0
    if not orders:
        return
    assert splats.sh is not None
    if splats.sh.shape[1] < 16 * (1 + orders) or splats.times is None:
        found = f"{splats.sh.shape[1]} coefficients, times "
        found += f"{'' if splats.times is not None else 'not '}given"
        expected = f"times, and at least {16 * (1 + orders)} for {orders} cosines"
        remedy = "Use fewer cosines or pass all coefficients."
        raise InputError("SpacetimeSplats.sh", found, expected, remedy)


# ---- compiled code -----------------------------------------------------------------------------


Way = Literal["slice", "unslice"]
"""Forward, and backward."""


@dataclass(frozen=True)
class SliceKernels:
    """The compiled functions that cut Gaussians."""

    where: torch.device  # of the tensors
    empty: Callable[..., Tensor]  # makes an uninitialised float32 tensor there, of a shape
    call: Callable[..., None]  # cuts or goes back: ``Way``, inputs, what was cut, gradients to fill


def of_cpu(engine: CpuEngine) -> SliceKernels:
    """fragprune_slice and fragprune_unslice of the compiled library."""
    made = partial(empty, engine.workspace)
    return SliceKernels(torch.device("cpu"), made, partial(run, engine.library))


def of_cuda(device: Device, where: torch.device) -> SliceKernels:
    """fp_slice and fp_unslice of native/cuda/slice.cu."""

    def call(way: Way, given: structs.Spacetime, *others: Any) -> None:
        passed, blocks = structs.Slicing(given, *others), blocks_of(given.count)
        launch(device, where, "slice", structs.MACROS, f"fp_{way}", blocks, passed)

    def made(*shape: int) -> Tensor:
        return torch.empty(shape, dtype=torch.float32, device=where)

    return SliceKernels(where, made, call)


@cache
def expect_right(device: Device, where: torch.device) -> None:
    """Cut a few Gaussians on a GPU, once for each, and compare with the oracle."""
    cut_there = partial(slice_by, of_cuda(device, where))
    # The host's first cut may come where it wants no gradients, or has new tensors elsewhere.
    with torch.inference_mode(False), torch.device("cpu"):
        cut = _some(cut_there, where, torch.float32)
        rights = _some(slice_by_oracle, torch.device("cpu"), torch.float64)
    for name, right in rights.items():
        away, largest = (cut[name] - right).abs().max(), right.abs().max()
        if not away <= 1e-3 * largest:
            found = f"a cut in time whose {name} are off by {away:.2g}"
            expected = f"at most {1e-3 * largest:.2g}, a thousandth of the largest"
            remedy = "Run on the CPU (--device cpu), and report this with the GPU's name."
            raise EngineError(f"engine 'cuda' on {where}", found, expected, remedy)


def _some(cut: Any, where: torch.device, dtype: torch.dtype) -> dict[str, Tensor]:
    """What a function cuts of 3,000 Gaussians, and their gradients; float64 on the CPU."""
    count, generator = 3000, torch.Generator().manual_seed(3000)

    def normal(*shape: int) -> Tensor:
        return torch.randn(count, *shape, generator=generator)

    given = {
        "means": normal(3) + torch.tensor([0.0, 0.0, 4.0]),
        "opacities": normal().sigmoid(),
        "times": torch.linspace(0, 1, count),
        "scales": 0.3 * normal(3).exp(),
        "scales_t": torch.full((count,), 0.3),
        "rotations": torch.nn.functional.normalize(normal(4)),
        "rotations_r": torch.nn.functional.normalize(normal(4)),
        "sh": 0.2 * normal(16, 3),
    }
    leaves: dict[str, Any] = {
        name: each.to(where, dtype, copy=True).requires_grad_() for name, each in given.items()
    }
    moment = Moment(timestamp=0.4, campos=torch.zeros(3, dtype=dtype, device=where))
    result = cut(SpacetimeSplats(**leaves, sh_degree=3), moment)
    named = {name: getattr(result, name) for name in ("means", "cov3d", "opacities", "colors")}
    torch.autograd.backward([each.sum() for each in named.values()])
    named |= {f"gradients by {name}": leaf.grad for name, leaf in leaves.items()}
    return {name: each.detach().cpu().double() for name, each in named.items()}


# ---- autograd ----------------------------------------------------------------------------------

_SHAPE = frozenset(("scales", "scales_t", "rotations", "rotations_r"))

_FELT_BY = {
    "means": _SHAPE | {"means", "times"},
    "cov3d": _SHAPE | {"cov3d"},
    "opacities": _SHAPE | {"opacities", "times"},
    "colors": _SHAPE | {"sh", "means", "times"},
}
"""The inputs that affect each output. If none of them needs a gradient, an engine skips the
output's part of the backward pass; in fine-tuning that is most of it."""


def slice_by(kernels: SliceKernels, splats: SpacetimeSplats, moment: Moment) -> Sliced:
    """Cut the Gaussians at the moment; differentiable in every tensor of the splats."""
    held = {name: each for name, each in vars(splats).items() if isinstance(each, torch.Tensor)}
    read = {**held, "campos": moment.campos}
    arrays = {name: plain(each, kernels.where) for name, each in read.items()}
    n, sh, orders = len(splats), arrays.get("sh"), moment.sh_degree_t
    given = structs.Spacetime(
        **vars(moment) | arrays | {"sh_degree_t": -1 if orders is None else orders},
        threads=native_threads(),
        sh_degree=splats.sh_degree,
        sh_coefficients=0 if sh is None else sh.shape[1],
        count=n,
        lengths=binding.Lengths(**{name: each.numel() for name, each in arrays.items()}),
    )
    present = torch.empty(n, dtype=torch.bool, device=kernels.where)

    def forward(wanted: Wanted) -> dict[str, Tensor]:
        made = {"means": (n, 3), "cov3d": (n, 6), "opacities": (n,)}
        made |= {} if sh is None else {"colors": (n, 3)}
        cut = {name: kernels.empty(*shape) for name, shape in made.items()} | {"present": present}
        kernels.call("slice", given, structs.Sliced(**cut))
        return cut

    def backward(wanted: Wanted, by: dict[str, Tensor]) -> dict[str, Tensor]:
        by = {name: plain(grad, kernels.where) for name, grad in by.items()} | {"present": present}
        grads = {name: kernels.empty(*arrays[name].shape) for name in wanted}
        kernels.call("unslice", given, structs.Sliced(**by), structs.SpacetimeGrads(**grads))
        return grads

    cut = in_graph(held, forward, backward, _FELT_BY)
    return Sliced(**{name: each.to(splats.device) for name, each in cut.items()})
