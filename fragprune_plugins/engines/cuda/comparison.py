"""Compares the cuda engine with engines that need no GPU, on frames of many thread blocks.

Large frames are compared with the cpu engine's, small frames with the oracle's, and sorted keys
with torch's. Repeated frames must be the same and must not accumulate memory. As a program it is
the process that ``self_check`` starts.
"""

from __future__ import annotations

import sys
from collections.abc import Iterator
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any

import torch

from fragprune_plugins.engines import create_engine
from fragprune_plugins.engines.cpu import binding
from fragprune_plugins.engines.cuda import driver
from fragprune_plugins.engines.cuda.engine import CudaEngine
from fragprune_plugins.engines.cuda.frame import (
    DIGITS,
    PASSES,
    SORT_KEYS,
    THREADS,
    Device,
    Sort,
    launch_sort,
)
from fragprune_plugins.engines.cuda.self_check import BEGUN, COULD_NOT_RUN, FAILS
from fragprune_plugins.engines.reference import ReferenceEngine
from fragprune_plugins.errors import KernelError
from fragprune_plugins.types import RasterInputs, Splats, View

if TYPE_CHECKING:
    from torch import Tensor

    from fragprune_plugins.engines import Engine


@dataclass(frozen=True)
class Workload:
    """How much is drawn. Sizes are in pixels."""

    keys: int = 3_000_000  # to sort
    gaussians: int = 300_000  # some tiles' lists are longer than a block's 256 threads
    size: tuple[int, int] = (1237, 822)
    wide_gaussians: int = 20_000
    wide_size: tuple[int, int] = (4112, 4112)  # so many tiles that sorting needs three passes
    steps: int = 50  # how often the large frame is drawn and differentiated


def compare(gpu: Device, where: torch.device, workload: Workload | None = None) -> list[str]:
    """All differences of the cuda engine. Without a cpu engine large frames are only repeated."""
    workload = Workload() if workload is None else workload
    return [
        *_sorting(gpu, where, workload.keys),
        *_small_frame(gpu, where),
        *_large_frame(gpu, where, workload),
        *_wide_frame(gpu, where, workload),
    ]


def _sorting(gpu: Device, where: torch.device, count: int) -> Iterator[str]:
    """Sort keys that are nearly all different, and keys with few values: equal keys keep order."""
    for bits in (31, 9):
        generator = torch.Generator().manual_seed(bits)
        keys = torch.randint((1 << bits) - 1, (count,), generator=generator, dtype=torch.int32)
        digits = [(keys >> 8 * k & DIGITS - 1).bincount(minlength=DIGITS) for k in range(PASSES)]
        histogram = torch.cat(digits).int().to(where)
        words = torch.zeros(PASSES * -(-count // SORT_KEYS) * DIGITS, dtype=torch.int32)
        words, tickets = words.to(where), torch.zeros(PASSES, dtype=torch.int32, device=where)
        total = torch.tensor([count], device=where)
        arguments = Sort(
            count=total, capacity=count, histogram=histogram, words=words, ticket=tickets
        )
        sorted_keys = keys.to(where, copy=True)
        order = torch.arange(count, dtype=torch.int32, device=where)
        others = torch.empty_like(sorted_keys), torch.empty_like(order)
        keys_at, values_at = (
            [one.data_ptr(), other.data_ptr()]
            for one, other in zip((sorted_keys, order), others, strict=True)
        )
        launch_sort(gpu, where, arguments, keys_at, values_at, PASSES)
        expected = keys.sort(stable=True)
        wrong = (sorted_keys.cpu() != expected.values) | (order.cpu() != expected.indices)
        if wrong.any():
            yield f"sorting: {int(wrong.sum())} of {count} are not where torch.sort has them"


def _small_frame(gpu: Device, where: torch.device) -> Iterator[str]:
    inputs, thresholds = scene(200, (70, 50), 3.0)
    wide = on(inputs, "cpu", torch.float64)
    expected = drawn_and_learned(ReferenceEngine(), wide, thresholds)
    found = drawn_and_learned(CudaEngine(gpu), on(inputs, where), thresholds)
    yield from differences("small frame", found, expected)


def _large_frame(gpu: Device, where: torch.device, workload: Workload) -> Iterator[str]:
    inputs, thresholds = scene(workload.gaussians, workload.size, 1.5)
    there = on(inputs, where)
    fast, ordered = (CudaEngine(gpu, deterministic=way) for way in (False, True))
    in_order = drawn_and_learned(ordered, there, thresholds)
    again = drawn_and_learned(ordered, there, thresholds)
    for name, each in in_order.items():
        if not torch.equal(each, again[name]):
            yield f"large frame, deterministic: {name} is another in another run"
    held = []
    for _ in range(workload.steps):
        found = drawn_and_learned(fast, there, thresholds)
        held.append(bytes_held(where))
        if not torch.equal(found["picture"], in_order["picture"]):
            yield "large frame: picture is another in another run"
            break
    if held[-1] - held[0] > 1024 * len(held):
        yield f"large frame: {held[-1] - held[0]} bytes more are held after {len(held)} steps"
    if binding.available():
        expected = drawn_and_learned(create_engine("cpu"), inputs, thresholds)
        yield from differences("large frame, deterministic", in_order, expected)
        yield from differences("large frame", found, expected)


def _wide_frame(gpu: Device, where: torch.device, workload: Workload) -> Iterator[str]:
    if not binding.available():
        return
    inputs, thresholds = scene(workload.wide_gaussians, workload.wide_size, 5.0)
    with torch.no_grad():
        found = CudaEngine(gpu).rasterize(on(inputs, where), thresholds.to(where)).image.cpu()
        expected = create_engine("cpu").rasterize(inputs, thresholds).image
    yield from differences("wide frame", {"picture": found}, {"picture": expected})


def bytes_held(where: torch.device) -> int:
    """Bytes that tensors hold on a GPU."""
    return torch.cuda.memory_allocated(where)


# ---- what counts as a difference ---------------------------------------------------------------


def differences(what: str, found: dict[str, Tensor], expected: dict[str, Tensor]) -> Iterator[str]:
    """Name every difference between two results of ``drawn_and_learned``.

    One engine may draw a fragment on a cut that the other does not. This is rare, can happen
    anywhere, and can change a pixel by any amount. So a few pixels and rows may differ, but not
    many in one warp's sub-tile or among the rows of one thread block.
    """
    for name, right in expected.items():
        away = (found[name] - right).abs()
        if name == "picture":
            off = ~(away.amax(0) <= 4e-5)
            filled = torch.nn.functional.pad(off, (0, -off.shape[1] % 8, 0, -off.shape[0] % 4))
            together, most = filled.unfold(0, 4, 4).unfold(1, 8, 8).sum((2, 3)), 4
        else:
            size = right.reshape(len(right), -1).abs().amax(1)
            usual = size[size > 0].median() if size.any() else size.sum()
            off = ~(away.reshape(len(right), -1).amax(1) <= 1e-3 * size + 1e-4 * usual)
            filled = torch.nn.functional.pad(off, (0, -len(off) % THREADS))
            together, most = filled.reshape(-1, THREADS).sum(1), THREADS // 8
        if off.double().mean() > 1 / 200 or together.max() > most:
            yield (
                f"{what}, {name}: {int(off.sum())} of {off.numel()} are off, {int(together.max())} "
                f"of them side by side, by up to {away.max():.2g}"
            )


# ---- what is drawn -----------------------------------------------------------------------------


def scene(count: int, size: tuple[int, int], extent: float) -> tuple[RasterInputs, Tensor]:
    """Gaussians all over a picture, and thresholds (N,); always the same, float32 on the CPU.

    At least one of each thousand is a giant, half as wide as the picture: all threads of a warp
    write its tiles, in several rounds if the picture has more than 32 rows of tiles. Some lie off
    the picture or behind the camera. ``extent`` is the median standard deviation, pixels.
    """
    generator = torch.Generator().manual_seed(count)
    width, height = size

    def uniform(low: float, high: float, *shape: int) -> Tensor:
        return torch.rand(*shape, generator=generator) * (high - low) + low

    def normal(*shape: int) -> Tensor:
        return torch.randn(*shape, generator=generator)

    index = torch.arange(count)
    depths = uniform(1.5, 12.0, count).where(index % 50 != 49, -2.0)
    tangents = uniform(-0.55, 0.55, count, 2) * torch.tensor([1.0, height / width])
    pixels = extent * torch.exp(0.6 * normal(count, 3))
    pixels[::1000] = width / 12
    splats = Splats(
        means=torch.cat([tangents * depths[:, None], depths[:, None]], 1),
        opacities=uniform(0.02, 0.7, count),
        scales=pixels * depths.abs()[:, None] / width,
        rotations=torch.nn.functional.normalize(normal(count, 4)),
        sh=0.2 * normal(count, 16, 3),
        sh_degree=3,
    )
    lens = {"width": width, "height": height, "fx": width, "fy": width}
    background = torch.tensor([0.1, 0.2, 0.3])
    view = View.pinhole(torch.eye(3), torch.zeros(3), **lens, background=background)
    return RasterInputs(view, splats), 10 ** uniform(-4.0, -0.3, count)


def on(
    inputs: RasterInputs, where: torch.device | str, dtype: torch.dtype = torch.float32
) -> RasterInputs:
    """The same inputs on a device."""

    def moved(value: View | Any) -> dict[str, Any]:
        tensors = {k: t for k, t in vars(value).items() if isinstance(t, torch.Tensor)}
        return {name: tensor.to(where, dtype) for name, tensor in tensors.items()}

    view = replace(inputs.view, **moved(inputs.view))
    return replace(inputs, view=view, splats=replace(inputs.splats, **moved(inputs.splats)))


def drawn_and_learned(
    engine: Engine, inputs: RasterInputs, thresholds: Tensor | None
) -> dict[str, Tensor]:
    """The picture (3, H, W), and gradients of every tensor that gets one, by name; on the CPU.

    Without thresholds they are of the picture alone.
    """
    like = inputs.splats.opacities
    given = {name: getattr(inputs.splats, name) for name in LEARNED}
    given |= {"background": inputs.view.background, "hook": like.new_zeros(len(like), 3)}
    given |= {} if thresholds is None else {"thresholds": thresholds}
    leaves = {k: t.detach().to(like, copy=True).requires_grad_() for k, t in given.items()}
    made = replace(
        inputs,
        view=replace(inputs.view, background=leaves["background"]),
        splats=replace(inputs.splats, **{name: leaves[name] for name in LEARNED}),
        means2d_hook=leaves["hook"],
    )
    out = engine.rasterize(made, leaves.get("thresholds"))
    asked = torch.rand(out.image.shape, generator=torch.Generator().manual_seed(0)) - 0.3
    pressed = [out.image] if thresholds is None else [out.image, out.fragments_per_pixel]
    weights = [asked, torch.tensor(1e3)][: len(pressed)]
    torch.autograd.backward(pressed, [w.to(o) for w, o in zip(weights, pressed, strict=True)])
    found = {f"gradient of {k}": leaf.grad for k, leaf in leaves.items() if leaf.grad is not None}
    return {name: each.detach().cpu() for name, each in {"picture": out.image, **found}.items()}


LEARNED = ("means", "opacities", "scales", "rotations", "sh")


def main(device: str) -> int:
    """The check's own process."""
    where, begun = torch.device(device), False
    try:
        torch.zeros(1, device=where)
        gpu = driver.Driver()
        begun = True
        print(BEGUN, flush=True)
        found = compare(gpu, where)
    except Exception as why:
        # Torch's allocator has an error of its own. Kernels need memory, too, when they first run.
        short = "out of memory" in str(why).replace("_", " ").lower()
        short |= isinstance(why, (KernelError, MemoryError, torch.cuda.OutOfMemoryError))
        print(f"{type(why).__name__}: {why}".splitlines()[0], file=sys.stderr)
        return FAILS if begun and not short else COULD_NOT_RUN
    print("; ".join(found), file=sys.stderr)
    return FAILS if found else 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1]))
