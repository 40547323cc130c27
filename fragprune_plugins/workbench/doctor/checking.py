"""Holds engines against the oracle in float64: pictures, gradients, and drawn fragments."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace
from functools import cache
from typing import Any

import torch
from torch import Tensor

from fragprune_plugins.engines import Engine
from fragprune_plugins.engines.cuda import comparison
from fragprune_plugins.engines.reference import ReferenceEngine
from fragprune_plugins.errors import FragpruneError
from fragprune_plugins.types import RasterInputs, Splats, one_line
from fragprune_plugins.workbench.bench.scene import make_scene, make_view

TRUNCATION = 16 / 255
"""One threshold for all Gaussians of the timed scene."""

MISCOUNTED = 1 / 500
"""The share of pixels whose fragments may be counted otherwise.

A fragment within rounding of its cut, a millionth of its falloff, is drawn by one and not by the
other. That is one pixel in thousands; an error of a thousandth is seen in one in a hundred.
"""

PEER_PICTURE_DB, PEER_GRADIENT = 50.0, 0.01
"""Peers end Gaussians at other radii: what their pictures and gradients may differ by.

PSNR of the picture, and the relative L2 error of each gradient.
"""

_LEARNED = ("means", "opacities", "scales", "rotations", "sh")
_FAILURES = (FragpruneError, RuntimeError, TypeError, AttributeError)


@dataclass(frozen=True, eq=False)
class Scene:
    """What is drawn.

    Attributes:
        thresholds: (N,), or None for no cutoffs.
    """

    name: str
    inputs: RasterInputs
    thresholds: Tensor | None
    __repr__ = one_line


@cache
def scenes() -> tuple[Scene, ...]:
    """Always the same, float32 on the CPU; small, for the oracle and the emulation are slow.

    In the last, several blocks sort, and tiles' lists are longer than a block's 256 threads.
    """
    inputs, thresholds = comparison.scene(200, (70, 50), 3.0)
    timed = RasterInputs(make_view(64, 48), make_scene(6000).splats())
    return (
        Scene("cutoffs", inputs, thresholds),
        Scene("no cutoffs", inputs, None),
        Scene("a stop", replace(inputs, stop=0.05), thresholds),
        Scene("the timed scene, small", timed, torch.full((6000,), TRUNCATION)),
    )


def held(engine: Engine, where: str, scene: Scene) -> dict[str, Any]:
    """A row of the proof: what an engine of ours draws of a scene, and what is wrong with it."""
    expected = _expected(scene)
    differences, counted = [], None
    try:
        found = _drawn(engine, comparison.on(scene.inputs, where), scene.thresholds)
    except _FAILURES as error:
        differences.append(f"{scene.name}: it fails: {str(error).splitlines()[0]}")
    else:
        fragments = found.pop("fragments")
        counted = float(fragments.double().mean())
        right = {name: each for name, each in expected.items() if name != "fragments"}
        differences += comparison.differences(scene.name, found, right)
        off = int((fragments != expected["fragments"]).sum())
        if off > MISCOUNTED * fragments.numel():
            differences.append(
                f"{scene.name}, fragments: {off} of {fragments.numel()} pixels count others"
            )
    view = scene.inputs.view
    return {
        "scene": scene.name,
        "gaussians": len(scene.inputs.splats),
        "width": view.width,
        "height": view.height,
        "truncated": scene.thresholds is not None,
        "stop": scene.inputs.stop,
        "fragments_per_pixel": counted,
        "fragments_per_pixel_of_oracle": float(expected["fragments"].double().mean()),
        "differences": differences,
    }


@cache
def _expected(scene: Scene) -> dict[str, Tensor]:
    """What the oracle draws."""
    wide = comparison.on(scene.inputs, "cpu", torch.float64)
    return _drawn(ReferenceEngine(), wide, scene.thresholds)


def _drawn(engine: Engine, inputs: RasterInputs, thresholds: Tensor | None) -> dict[str, Tensor]:
    """The picture, its gradients by name, and (H, W) drawn fragments; on the CPU."""
    if thresholds is None:
        found = learned(engine, inputs)
    else:
        found = comparison.drawn_and_learned(engine, inputs, thresholds)
        thresholds = thresholds.to(inputs.splats.opacities)
    with torch.no_grad():
        fragments = engine.rasterize(replace(inputs, counts=True), thresholds).fragments
    assert fragments is not None  # they were asked for
    return found | {"fragments": fragments.cpu()}


def learned(engine: Engine, inputs: RasterInputs) -> dict[str, Tensor]:
    """The picture without thresholds, and its gradients by name; on the CPU."""
    assert isinstance(inputs.splats, Splats)
    leaves = {
        name: getattr(inputs.splats, name).detach().clone().requires_grad_() for name in _LEARNED
    }
    image = engine.rasterize(replace(inputs, splats=replace(inputs.splats, **leaves)), None).image
    asked = torch.rand(image.shape, generator=torch.Generator().manual_seed(0)) - 0.3
    torch.autograd.backward(image, asked.to(image))
    gradients = {name: leaf.grad for name, leaf in leaves.items() if leaf.grad is not None}
    return {name: each.detach().cpu() for name, each in {"picture": image, **gradients}.items()}


def peer_differences(engine: Engine, where: str) -> Iterator[str]:
    """Where another rasterizer, which knows no thresholds, draws otherwise than the oracle."""
    inputs = scenes()[0].inputs
    expected = learned(ReferenceEngine(), comparison.on(inputs, "cpu", torch.float64))
    try:
        found = learned(engine, comparison.on(inputs, where))
    except _FAILURES as error:
        yield f"it fails: {str(error).splitlines()[0]}"
        return
    picture = found.pop("picture"), expected.pop("picture")
    mse = float((picture[0].double() - picture[1]).square().mean())
    if not mse <= 10 ** (-PEER_PICTURE_DB / 10):
        yield f"another picture: its mean squared error is {mse:.2g}"
    for name, right in expected.items():
        away = float((found[name].double() - right).norm() / right.norm())
        if not away <= PEER_GRADIENT:
            yield f"another gradient of {name}: off by {away:.1%}"
