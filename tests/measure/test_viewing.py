"""Cameras that are given by what they look at, and pictures from Python."""

from dataclasses import replace

import numpy as np
import pytest
import torch
from finetune import tiny
from hypothesis import assume, given
from hypothesis import strategies as st
from PIL import Image

import fragprune_plugins as fp
from fragprune_plugins.errors import InputError

axis = st.floats(-5, 5).map(lambda x: round(x, 3))
point = st.tuples(axis, axis, axis)


def pixel(view, where):
    """Where a point lands, in units of half the picture, and its depth."""
    seen = torch.tensor([*where, 1.0]) @ view.projmatrix
    return seen[:2] / seen[3], float((torch.tensor([*where, 1.0]) @ view.viewmatrix)[2])


@given(point, point, point)
def test_the_target_is_in_the_middle_and_up_is_up(eye, target, up):
    way, over = torch.tensor(target) - torch.tensor(eye), torch.tensor(up)
    assume(float(torch.linalg.cross(way, over).norm()) > 0.1 * float(way.norm() * over.norm()))
    assume(float(way.norm()) > 0.1 and float(over.norm()) > 0.1)
    view = fp.look_at(eye, target, up, width=40, height=30, fov_y=60)
    where, depth = pixel(view, target)
    assert torch.allclose(where, torch.zeros(2), atol=1e-3)
    assert depth == pytest.approx(float(way.norm()), rel=1e-3)
    a_bit_up = torch.tensor(target) + 0.01 * over / over.norm() * way.norm()
    where, _ = pixel(view, a_bit_up.tolist())
    assert abs(float(where[0])) < 1e-3
    assert float(where[1]) < 0  # rows count downwards
    assert torch.allclose(view.campos, torch.tensor(eye), atol=1e-4)
    turn = view.viewmatrix[:3, :3]
    assert torch.allclose(turn @ turn.T, torch.eye(3), atol=1e-5)
    assert float(torch.linalg.det(turn)) == pytest.approx(1, abs=1e-4)


def test_the_field_of_view_is_that_of_the_height():
    view = fp.look_at((0, 0, -1), (0, 0, 0), width=200, height=100, fov_y=90)
    assert view.tan_fov_y == pytest.approx(1)
    assert view.tan_fov_x == pytest.approx(2)
    where, _ = pixel(view, (0.0, 1.0, 0.0))
    assert where.tolist() == pytest.approx([0, 1])  # the lower edge: up is -y


@pytest.mark.parametrize(
    "changes",
    [
        *({"up": up} for up in ((0, 0, 2), (0, 0, 0), (0, 1))),
        *({"target": (0, 0, 0)}, {"eye": (float("nan"), 0, 0)}, {"eye": (0, 0)}),
        *({"fov_y": 180}, {"fov_y": 0}, {"width": 0}, {"height": 0}),
    ],
)
def test_a_camera_that_sees_nothing_is_refused(changes):
    with pytest.raises(InputError):
        fp.look_at(**({"eye": (0, 0, 0), "target": (0, 0, 1), "width": 8} | changes))
    if not changes.keys() & {"eye", "target"} and changes != {"up": (0, 0, 2)}:
        with pytest.raises(InputError):
            fp.overview(tiny.random_model(), **changes)


def test_an_autocast_around_them_changes_neither_cameras_nor_pictures():
    model = tiny.random_model()

    def drawn():
        view = fp.overview(model, width=32, height=24)
        picture = fp.rasterize(fp.RasterInputs(view, model.splats()), engine="reference").image
        return view.viewmatrix, view.projmatrix, view.campos, picture

    plain = drawn()
    with torch.autocast("cpu"):
        assert all(map(torch.equal, drawn(), plain))


@pytest.mark.parametrize("up", [(0, -1, 0), (0, 0, 1), (0, 0, -3), (1, 1, 0)])
@pytest.mark.parametrize("size", [(60, 40), (30, 50)])
def test_the_overview_shows_nine_tenths_however_far_the_others_float(up, size):
    width, height = size
    splat = tiny.random_model(count=100)
    xyz = splat.xyz * 7 + torch.tensor([3.0, -20.0, 8.0])
    xyz[:9] += 1e4
    view = fp.overview(replace(splat, xyz=xyz), up, width=width, height=height)
    shown = [pixel(view, each) for each in xyz.tolist()]
    assert sum(float(at.abs().max()) <= 1 and depth > 0 for at, depth in shown) >= 90
    assert (view.width, view.height) == size


def test_ply_to_png_in_three_lines(tmp_path):
    splat = tiny.random_model()
    fp.save(tmp_path / "model.ply", splat)

    model = fp.load(tmp_path / "model.ply")
    fp.render_view(model).save(tmp_path / "view.png")

    with Image.open(tmp_path / "view.png") as picture:
        assert (picture.size, picture.mode) == ((960, 720), "RGB")
        assert np.asarray(picture).max() > 100
    assert fp.render_view(splat) == fp.render_view(model)


def test_a_picture_is_truncated_as_the_thresholds_say():
    splat, view = tiny.random_model(), tiny.cameras()[0].view()
    cut = torch.full((len(splat),), 0.6)
    drawn = np.asarray(fp.render_view(tiny.cut(splat, cut), view))
    with torch.no_grad():
        image = fp.rasterize(fp.RasterInputs(view, splat.splats()), cut).image
    expected = (255 * image.clamp(0, 1)).round().byte().permute(1, 2, 0).numpy()
    assert np.array_equal(drawn, expected)
    assert not np.array_equal(drawn, np.asarray(fp.render_view(splat, view)))


@pytest.mark.parametrize("value", [-0.1, 1.5, 9.0, float("nan")])
def test_thresholds_that_are_no_falloffs_are_refused(value):
    """They would draw nothing, or not what was meant: 9 is the cutoff of three deviations."""
    model = tiny.random_model()
    inputs = fp.RasterInputs(fp.overview(model, width=32, height=24), model.splats())
    with pytest.raises(InputError, match=r"thresholds: numbers outside \[0, 1\]"):
        fp.rasterize(inputs, torch.full((len(model),), value))
