"""What holds tensors is shown on one line, without their numbers."""

import dataclasses
import pkgutil
from dataclasses import replace
from importlib import import_module

import pytest
import torch
from finetune import tiny

import fragprune_plugins as fp
from fragprune_plugins.types import one_line, short

EXCLUDED = (".demo.host", ".testing", "__main__")


def holding_tensors():
    """Every dataclass of ours, but for private ones, one of whose fields is a tensor."""
    for found in pkgutil.walk_packages(fp.__path__, "fragprune_plugins."):
        if any(part in found.name for part in EXCLUDED) or ".native._" in found.name:
            continue
        for kind in vars(import_module(found.name)).values():
            if not (isinstance(kind, type) and dataclasses.is_dataclass(kind)):
                continue
            if kind.__module__ == found.name and not kind.__name__.startswith("_"):
                types = (str(each.type) for each in dataclasses.fields(kind))
                if any("Tensor" in name and "Callable" not in name for name in types):
                    yield kind


@pytest.mark.parametrize("kind", sorted(set(holding_tensors()), key=lambda kind: kind.__name__))
def test_a_dataclass_with_tensors_is_shown_short(kind):
    assert kind.__repr__ is one_line


def test_one_line_with_shapes_types_and_counts_and_without_the_numbers_of_tensors():
    splat, store = tiny.random_model(count=500), fp.ThresholdStore(500)
    inputs = fp.RasterInputs(tiny.cameras()[0].view(), splat.splats())
    outputs = fp.rasterize(replace(inputs, counts=True), tiny.cut(splat, 0.1).thresholds)
    for value in (inputs.view, inputs.splats, inputs, outputs):
        text = repr(value)
        assert text.startswith(type(value).__name__ + "(")
        assert "\n" not in text
        assert "tensor(" not in text
        assert len(text) < 800
    assert repr(store) == "ThresholdStore(logits=float32[500], steps=0)"
    assert repr(splat) == (
        "Model(xyz=float32[500, 3], f_dc=float32[500, 1, 3], f_rest=float32[500, 3, 3], "
        "opacity=float32[500, 1], scaling=float32[500, 3], rotation=float32[500, 4])"
    )
    model = replace(splat, thresholds=store)
    assert repr(model) == f"{repr(splat)[:-1]}, thresholds={store!r})"
    assert repr(inputs.view).startswith("View(width=32, height=32, tan_fov_x=0.44")
    assert "sh_degree=1" in repr(inputs.splats)
    assert "cov3d" not in repr(inputs.splats)  # what is not given is not shown


def test_another_device_is_named():
    assert short(torch.zeros(3, device="meta")) == "float32[3] on meta"
    assert short([1, 2]) == "[2 items]"
