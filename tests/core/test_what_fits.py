"""What does not fit the Gaussians is refused before anything is drawn, by every engine alike."""

from dataclasses import fields, replace

import pytest
import scenes
import spacetime
import torch

from fragprune_plugins import rasterize
from fragprune_plugins.engines import create_engine
from fragprune_plugins.engines.cpu import binding
from fragprune_plugins.errors import InputError

NONE = {
    "a number": lambda t: 0.1,
    "numpy": lambda t: t.detach().numpy(),
    "complex": lambda t: t.to(torch.complex64),
    "booleans": lambda t: t > 0,
    "without numbers": lambda t: t.to("meta"),
    "sparse": lambda t: t.to_sparse(),
    "a scalar": lambda t: t.sum(),
    "a dimension more": lambda t: t[..., None],
}
"""What is no array of the wanted numbers, made of one that is."""


@pytest.fixture(params=["reference", "cpu"])
def engine(request):
    if request.param == "cpu" and not binding.available():
        pytest.skip("no compiled rasterizer here")
    return create_engine(request.param)


@pytest.mark.parametrize("rows", [0, 1, 299, 301])
def test_thresholds_of_another_model_are_refused_with_both_counts(engine, rows):
    inputs = scenes.random_scene(0, 300)
    with pytest.raises(InputError, match=rf"\({rows},\).*; expected.*\(300,\)"):
        engine.rasterize(inputs, torch.full((rows,), 0.1))


def test_thresholds_that_are_no_array_are_refused(engine):
    for how in NONE.values():
        for draw in (engine.rasterize, rasterize):
            with pytest.raises(InputError, match="thresholds"):
                draw(scenes.random_scene(0), how(scenes.random_thresholds(0, 60)))


def test_thresholds_may_be_of_any_floating_type(engine):
    inputs = scenes.random_scene(0)
    for dtype in (torch.float16, torch.bfloat16, torch.float32, torch.float64):
        assert engine.rasterize(inputs, torch.full((60,), 0.5, dtype=dtype)).image.any()


WORLD = scenes.random_scene(0, 20, features=2, offsets=True)
COVARIANCES = scenes.random_scene(0, 20, cov3d=True, colors=True)
OWNERS = {
    "View": WORLD.view,
    "Splats": WORLD.splats,
    "Splats of covariances": COVARIANCES.splats,
    "Footprints": scenes.footprints_of(WORLD).splats,
    "RasterInputs": replace(WORLD, means2d_hook=torch.zeros(20, 3)),
    "SpacetimeSplats": spacetime.splats("joint", 20),
    "Moment": spacetime.moment(),
}


def tensors_of(owner):
    values = {field.name: getattr(owner, field.name) for field in fields(owner)}
    return {name: each.detach() for name, each in values.items() if torch.is_tensor(each)}


@pytest.mark.parametrize("kind", OWNERS)
def test_a_field_that_is_no_array_of_its_numbers_is_refused_by_name(kind):
    for name, value in tensors_of(OWNERS[kind]).items():
        for how in NONE.values():
            with pytest.raises(InputError, match=name):
                replace(OWNERS[kind], **{name: how(value)})


@pytest.mark.parametrize("kind", [kind for kind in OWNERS if kind not in ("View", "Moment")])
def test_a_field_of_other_rows_is_refused(kind):
    for name, value in tensors_of(OWNERS[kind]).items():
        with pytest.raises(InputError, match=r"shape \((19|27),"):
            replace(OWNERS[kind], **{name: value[:-1]})


def test_tiles_are_whole_numbers():
    prints = OWNERS["Footprints"]
    with pytest.raises(InputError, match="tiles"):
        replace(prints, tiles=prints.tiles.float())


def test_coefficients_have_a_bound():
    splats = WORLD.splats
    with pytest.raises(InputError, match="1025"):
        replace(splats, sh=torch.zeros(20, 1025, 3))
