"""Cameras around a splat and between given ones."""

import math
from dataclasses import replace

import pytest
import torch
from finetune import tiny
from hypothesis import given
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from fragprune_plugins import View, rasterize
from fragprune_plugins.errors import DatasetError
from fragprune_plugins.workbench.render.filming import orbit
from fragprune_plugins.workbench.scenes.generated import (
    around,
    beside,
    between,
    bounds,
    interpolate,
    own_pictures,
)

NUMBER = st.floats(-3, 3, width=32)
PLACE = st.tuples(NUMBER, NUMBER, NUMBER)
FIELDS = ("viewmatrix", "projmatrix", "campos")


def pose(axis, place, cx=20.0):
    """A camera turned by a rotation vector, at a place, its principal point off centre."""
    rotation = torch.from_numpy(Rotation.from_rotvec(axis).as_matrix())
    centre = torch.tensor(place, dtype=torch.float64)
    lens = {"width": 48, "height": 32, "fx": 40.0, "fy": 42.0, "cx": cx, "cy": 15.0}
    return View.pinhole(rotation, -rotation @ centre, **lens)


POSE = st.builds(pose, PLACE, PLACE)


def angle(one: View, other: View) -> float:
    turn = one.viewmatrix[:3, :3].T @ other.viewmatrix[:3, :3]
    return float(Rotation.from_matrix(turn.numpy()).magnitude())


@given(POSE, POSE)
def test_the_ends_of_the_way_are_the_cameras(a, b):
    for end, t in ((a, 0.0), (b, 1.0)):
        there = interpolate(a, b, t)
        for name in FIELDS:
            pair = getattr(there, name), getattr(end, name)
            torch.testing.assert_close(*pair, atol=1e-6, rtol=1e-6)


@given(POSE, POSE, st.floats(-1, 1))
def test_between_two_cameras_a_rotation_is_one_and_the_centre_on_the_line(a, b, t):
    view = interpolate(a, b, t)
    rotation = view.viewmatrix[:3, :3]
    torch.testing.assert_close(rotation @ rotation.T, torch.eye(3).double(), atol=1e-9, rtol=0)
    assert float(torch.det(rotation)) == pytest.approx(1)
    torch.testing.assert_close(view.campos, torch.lerp(a.campos, b.campos, t))
    at_itself = torch.cat([view.campos, torch.ones(1)]) @ view.viewmatrix
    torch.testing.assert_close(at_itself[:3], torch.zeros(3).double(), atol=1e-9, rtol=0)
    assert angle(a, view) == pytest.approx(abs(t) * angle(a, b), abs=1e-6)
    if t >= 0:
        assert angle(view, b) == pytest.approx((1 - t) * angle(a, b), abs=1e-6)


def test_the_lens_and_the_background_are_the_first_camera_s():
    a = replace(pose((0, 0, 0), (0, 0, 0)), background=torch.ones(3))
    b = pose((0, 1, 0), (1, 0, 0), cx=30.0)
    view = interpolate(a, b, 0.5)
    clip = torch.linalg.solve(view.viewmatrix, view.projmatrix)
    torch.testing.assert_close(clip, torch.linalg.solve(a.viewmatrix, a.projmatrix))
    assert torch.equal(view.background, torch.ones(3))
    assert (view.width, view.height, view.tan_fov_x) == (a.width, a.height, a.tan_fov_x)


def ring():
    return [(f"view{i}", camera.view()) for i, camera in enumerate(tiny.cameras(12))]


def test_every_camera_goes_towards_the_four_nearest():
    pairs = [tuple(map(int, name.replace("view", "").split("~"))) for name, _ in between(ring())]
    assert len(pairs) == 48
    for i, j in pairs:
        assert min((i - j) % 12, (j - i) % 12) in (1, 2)


def test_a_camera_nearby_that_looks_away_is_not_near():
    ahead = [(f"a{x}", pose((0, 0, 0), (float(x), 0, 0))) for x in range(5)]
    back = [(f"b{x}", pose((0, 3.14, 0), (x + 0.1, 0, 0))) for x in range(5)]
    assert all(name[0] == name.split("~")[1][0] for name, _ in between(ahead + back))


def test_two_cameras_have_one_way_each_and_fewer_none():
    assert [name for name, _ in between(ring()[:2])] == ["view0~view1", "view1~view0"]
    for few in ([], ring()[:1]):
        assert between(few) == beside(few, 3) == []
    with pytest.raises(DatasetError, match="at least two"):
        own_pictures(tiny.random_model(), ring()[:1])


def test_beside_each_camera_lie_others_on_the_way_to_its_neighbours_and_away_from_them():
    cameras = dict(ring())
    step = angle(*(cameras[name] for name in ("view0", "view1")))
    found = beside(ring(), 60)
    turns = [angle(cameras[name.split("~")[0]], view) for name, view in found]
    assert len({name for name, _ in found}) == 60
    assert max(turns) < 0.6 * 2 * step + 1e-6
    assert max(turns) > 0.6 * step
    middle = torch.stack([view.campos for view in cameras.values()]).mean(dim=0)
    radius = float((cameras["view0"].campos - middle).norm())
    far = [float((view.campos - middle).norm()) > radius for _, view in found]
    assert any(far)  # beyond a camera, off the ring
    assert not all(far)


def same(one, other):
    return all(
        name == also and torch.equal(view.projmatrix, again.projmatrix)
        for (name, view), (also, again) in zip(one, other, strict=True)
    )


def test_a_seed_gives_the_same_cameras_and_another_seed_others():
    model = tiny.random_model()
    for make in (
        lambda seed: around(model, seed=seed),
        lambda seed: between(ring(), seed=seed),
        lambda seed: beside(ring(), 9, seed=seed),
    ):
        assert same(make(3), make(3))
        assert not same(make(3), make(4))


def test_cameras_around_look_at_the_centre_from_all_sides_and_not_from_within():
    model = tiny.random_model()
    model.xyz[0] = 1e4  # floats far out
    centre, radius = bounds(model)
    assert radius < 3
    views = [view for _, view in around(model, 64)]
    sides = torch.stack([view.campos - centre for view in views])
    assert float(sides.norm(dim=1).min()) > radius
    signs = {tuple(side) for side in (sides > 0).tolist()}
    assert len(signs) == 8
    for view in views:
        middle = torch.cat([centre, torch.ones(1)]) @ view.projmatrix
        torch.testing.assert_close(middle[:2] / middle[3], torch.zeros(2), atol=1e-4, rtol=0)


@pytest.mark.parametrize("scale", [0.002, 0.05, 1.0, 50.0])
def test_a_splat_fills_its_pictures_whatever_its_unit(scale):
    splat = tiny.random_model(count=100)
    small = replace(splat, xyz=splat.xyz * scale, scaling=splat.scaling + math.log(scale))
    for cameras in (around(small, 6, pixels=64), orbit(small, 4, (0, -1, 0))):
        for _, view in cameras:
            outputs = rasterize(small, view)
            assert (outputs.radii > 0).float().mean() > 0.8
