"""The ellipses' area: against pixels counted one by one, and its gradient against differences."""

import math
from dataclasses import replace

import pytest
import scenes
import torch
from oracle import naive

from fragprune_plugins.engines import create_engine
from fragprune_plugins.learning.area import ellipse_areas
from fragprune_plugins.workbench.figures.evaluate import covered_per_pixel

F64 = torch.float64
WIDTH, HEIGHT = 112, 80


def counted(inputs):
    """Pixels in each Gaussian's ellipse of sqrt(8) standard deviations, by row."""
    view, found = inputs.view, {}
    for splat in naive.splats_of(inputs):
        a, b, c = splat.cov
        found[splat.row] = sum(
            c * dx * dx - 2 * b * dx * dy + a * dy * dy <= 8 * (a * c - b * b)
            for dx in (x - splat.pixel[0] for x in range(view.width))
            for dy in (y - splat.pixel[1] for y in range(view.height))
        )
    return [found.get(row, 0) for row in range(len(inputs.splats))]


@pytest.mark.parametrize("kind", ["scales", "cov3d", "footprints"])
def test_the_area_is_the_number_of_pixels_inside(kind):
    inputs = scenes.random_scene(3, 20, WIDTH, HEIGHT, dtype=F64, cov3d=kind == "cov3d")
    areas = ellipse_areas(scenes.footprints_of(inputs) if kind == "footprints" else inputs)
    for area, pixels in zip(areas.tolist(), counted(inputs), strict=True):
        # A count differs from the area by pixels on the rim; a share of a box is not one of an
        # ellipse at the picture's edge.
        assert area == pytest.approx(pixels, rel=0.1, abs=4 * math.sqrt(pixels) + 4)
    assert areas.sum().item() == pytest.approx(sum(counted(inputs)), rel=0.05)


@pytest.mark.parametrize("engine", ["reference", "cpu"])
def test_what_is_measured_is_counted_exactly_and_opacities_have_no_part_in_it(engine):
    inputs = scenes.random_scene(3, 20, WIDTH, HEIGHT, compensation="antialiasing")
    pixels = sum(counted(inputs))
    drawer = create_engine(engine)
    measured = WIDTH * HEIGHT * covered_per_pixel(drawer, inputs)
    assert measured == pytest.approx(pixels, abs=2)  # single precision on a rim
    faint = replace(inputs.splats, opacities=0.01 * inputs.splats.opacities)
    assert WIDTH * HEIGHT * covered_per_pixel(drawer, replace(inputs, splats=faint)) == measured


@pytest.mark.parametrize("kind", ["scales", "cov3d", "footprints"])
def test_gradients_are_finite_differences(kind):
    inputs = scenes.random_scene(5, 12, WIDTH, HEIGHT, dtype=F64, cov3d=kind == "cov3d")
    inputs = scenes.footprints_of(inputs) if kind == "footprints" else inputs
    names = {"scales": ("scales", "rotations"), "cov3d": ("cov3d",), "footprints": ("conics",)}

    def areas(*shapes):
        given = dict(zip(names[kind], shapes, strict=True))
        return ellipse_areas(replace(inputs, splats=replace(inputs.splats, **given)))

    shapes = [getattr(inputs.splats, name).detach().clone() for name in names[kind]]
    assert torch.autograd.gradcheck(areas, [each.requires_grad_() for each in shapes], eps=1e-7)


def test_positions_feel_no_pressure():
    inputs, leaves = scenes.leaves(scenes.random_scene(5, 12, WIDTH, HEIGHT))
    ellipse_areas(inputs).sum().backward()
    assert leaves["means"].grad is None
    assert leaves["opacities"].grad is None
    assert leaves["scales"].grad.abs().sum() > 0
