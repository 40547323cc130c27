"""Planes that nobody asked for are not drawn, and the others are the same without them."""

from dataclasses import replace

import pytest
import scenes
import torch

SIZE = (70, 50)


@pytest.mark.parametrize("planes", [(), ("alpha",), ("invdepth",), ("invdepth", "alpha")])
@pytest.mark.parametrize("kind", [{}, {"features": 2}], ids=["plain", "features"])
def test_a_plane_that_is_not_asked_for_changes_nothing_else(engine, planes, kind):
    inputs = scenes.random_scene(3, 60, *SIZE, **kind)
    thresholds = scenes.random_thresholds(3, 60)
    whole = engine.rasterize(inputs, thresholds)
    some = engine.rasterize(replace(inputs, planes=planes), thresholds)
    assert torch.equal(some.image, whole.image)
    assert torch.equal(some.radii, whole.radii)
    for name in ("invdepth", "alpha"):
        assert torch.equal(getattr(some, name), getattr(whole, name)[: int(name in planes)])


def test_gradients_of_the_image_alone_are_the_same(engine):
    grads = []
    for planes in ((), ("invdepth", "alpha")):
        made, leaves = scenes.leaves(scenes.random_scene(4, 60, *SIZE))
        image = engine.rasterize(replace(made, planes=planes), None).image
        image.square().sum().backward()
        grads.append({name: leaf.grad for name, leaf in leaves.items()})
    for name, grad in grads[0].items():
        assert torch.equal(grad, grads[1][name]), name


def test_a_picture_that_gets_no_gradients_takes_no_trouble_for_them(engine):
    """A trained model's parameters want some wherever they are drawn; rims need more lanes then."""
    inputs, plain = scenes.random_scene(3, 60, *SIZE), scenes.random_thresholds(3, 60)
    expected = engine.rasterize(inputs, plain).evaluated_per_pixel
    made, _ = scenes.leaves(inputs)
    wanting = plain.clone().requires_grad_()
    assert engine.rasterize(made, wanting).evaluated_per_pixel > expected
    with torch.no_grad():
        assert engine.rasterize(made, wanting).evaluated_per_pixel == expected
