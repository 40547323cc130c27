"""What viewers with rules of their own are asked to shade."""

import math

import pytest
import torch
from finetune import tiny

from fragprune_plugins import RasterInputs, look_at
from fragprune_plugins.engines.reference import ReferenceEngine
from fragprune_plugins.workbench.figures.extents import CUTS, SQRT8, VIEWERS, Extent, Viewer, shaded

BY_NAME = {viewer.names.split(",")[0]: viewer for viewer in VIEWERS}


def one(opacity=0.5, size=0.2):
    """A round Gaussian in the middle of the picture, and its variance there, pixels^2."""
    splat = tiny.round_ones(torch.zeros(1, 3), size, opacity)
    view = look_at((0, 0, -4), (0, 0, 0), width=160, height=160, fov_y=53.13)
    focal = 160 / (2 * view.tan_fov_y)
    return RasterInputs(view, splat.splats()), (focal * size / 4) ** 2 + 0.3


@pytest.mark.parametrize(
    ("viewer", "opacity", "squared"),
    [
        *(("antimatter15/splat", opacity, 8.0) for opacity in (0.5, 0.02)),  # however faint
        ("three.js GaussianSplatMesh", 0.02, 4.0),
        *(("PlayCanvas", 0.5, 8.0), ("PlayCanvas", 0.002, 0.0)),
        ("PlayCanvas", 0.05, 2 * math.log(255 * 0.05)),
    ],
)
def test_a_quad_around_one_gaussian(viewer, opacity, squared):
    inputs, variance = one(opacity)
    pixels = shaded(ReferenceEngine(), inputs, BY_NAME[viewer]) * 160 * 160
    side = 2 * math.sqrt(squared * variance)
    assert pixels == pytest.approx(side**2, rel=0.03, abs=2)  # an ellipse's pixels are counted


def test_tiles_of_the_host_are_those_of_the_oracle():
    splats = tiny.random_model(count=200).splats()
    view = look_at((0, 0, -2.5), (0, 0, 0), width=96, height=64)
    inputs = RasterInputs(view, splats, planes=())
    out = ReferenceEngine().rasterize(inputs, None)
    host = BY_NAME["3DGS reference (CUDA)"]
    assert shaded(ReferenceEngine(), inputs, host) == pytest.approx(out.evaluated_per_pixel)


def test_tiles_of_a_box_that_follows_the_opacity():
    inputs, variance = one(0.05, size=0.3)
    half = math.ceil(math.sqrt(2 * math.log(255 * 0.05) * variance))
    first, last = math.floor((79.5 - half) / 16), math.ceil((79.5 + half) / 16)
    expected = (last - first) ** 2 * 256 / 160**2
    assert shaded(ReferenceEngine(), inputs, BY_NAME["gsplat 1.5"]) == pytest.approx(expected)


@pytest.mark.parametrize("extent", [*CUTS, SQRT8], ids=lambda extent: extent.name)
def test_thresholds_end_where_the_rule_does(extent):
    opacities = torch.tensor([0.004, 0.02, 0.3, 0.9], dtype=torch.float64)
    thresholds = extent.thresholds(opacities)
    assert ((thresholds > 0) & (thresholds <= 1)).all()
    kept = extent.squared(opacities) >= 0
    at_rim = thresholds[kept]
    assert torch.allclose(-2 * at_rim.log(), extent.squared(opacities)[kept])
    if extent.alpha:
        assert (at_rim * opacities[kept] >= extent.alpha * (1 - 1e-9)).all()


def test_a_smaller_extent_never_shades_more():
    inputs = RasterInputs(tiny.cameras()[0].view(), tiny.random_model().splats())
    for shape in ("quad", "square", "box"):
        pixels = [
            shaded(ReferenceEngine(), inputs, Viewer("", Extent("", sigmas), shape))
            for sigmas in (1.0, 2.0, math.sqrt(8), 3.0)
        ]
        assert pixels == sorted(pixels)
        assert pixels[0] < pixels[-1]
