"""What answers for the hosts' compiled packages, against re-derivations in plain Python."""

import math

import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

from fragprune_graphdeco import stand_ins
from fragprune_graphdeco.stand_ins import compute_relocation, mean_squared_neighbour_distance

coordinates = st.tuples(*[st.integers(-20, 20).map(lambda i: i / 4)] * 3)


@given(st.lists(coordinates, max_size=25))
def test_neighbour_distances_are_those_of_a_brute_force_search(points):
    cloud = torch.tensor(points, dtype=torch.float32).reshape(-1, 3)
    expected = []
    for i, p in enumerate(points):
        near = sorted(math.dist(p, q) ** 2 for j, q in enumerate(points) if j != i)[:3]
        expected.append(sum(near) / len(near) if near else 0.0)
    found = mean_squared_neighbour_distance(cloud)
    assert found.dtype == torch.float32
    torch.testing.assert_close(found, torch.tensor(expected).reshape(-1), rtol=1e-5, atol=1e-6)


def test_simple_knn_answers_under_both_its_names():
    modules = stand_ins.simple_knn()
    assert set(modules) == {"simple_knn", "simple_knn._C"}
    assert modules["simple_knn"]._C is modules["simple_knn._C"]
    with pytest.raises(AttributeError):  # dunders included: torch's inspection asks for them
        modules["simple_knn._C"].__wrapped__  # noqa: B018


@given(st.floats(0.005, 0.999), st.integers(1, 50), st.floats(0.01, 10.0))
def test_relocated_copies_look_like_the_one_they_replace(old, count, scale):
    """At the centre, and integrated along a line: by quadrature, where the formula is a sum."""
    opacity, scales = compute_relocation(
        torch.tensor([old], dtype=torch.float64),
        torch.full((1, 3), scale, dtype=torch.float64),
        torch.tensor([count]),
        torch.empty(0),
        51,
    )
    assert 1 - (1 - opacity.item()) ** count == pytest.approx(old, rel=1e-9)
    t = torch.linspace(-9, 9, 20_001, dtype=torch.float64)  # in standard deviations
    falloff = torch.exp(-t.square() / 2)
    together = 1 - (1 - opacity * falloff) ** count
    old_area = scale * old * math.sqrt(2 * math.pi)
    for width in scales:
        assert (width * torch.trapezoid(together, t)).item() == pytest.approx(old_area, rel=1e-8)


def test_one_gaussian_in_place_of_one_is_itself():
    old, scales = torch.tensor([0.1, 0.95]), torch.tensor([0.2, 1.0, 3.0]).expand(2, 3).contiguous()
    counts = torch.ones(2, dtype=torch.int32)
    opacity, flat = compute_relocation(old, scales, counts, torch.zeros(51, 51), 51)
    assert (opacity.dtype, flat.dtype, flat.shape) == (torch.float32, torch.float32, (6,))
    torch.testing.assert_close(opacity, old)
    torch.testing.assert_close(flat, scales.reshape(-1))


def rasterizer(draw=lambda call: call):
    return stand_ins.rasterizer("a_package", ("bg", "viewmatrix", "debug"), draw)


def test_the_rasterizer_takes_positional_and_keyword_calls_alike():
    module = rasterizer()
    settings = module.GaussianRasterizationSettings(bg=1, viewmatrix=2, debug=False)
    assert settings._fields == ("bg", "viewmatrix", "debug")
    draw = module.GaussianRasterizer(raster_settings=settings)
    by_keyword = draw(means3D=1, means2D=2, opacities=3, shs=4, scales=5, rotations=6)
    by_position = draw(1, 2, 3, 4, None, 5, 6)
    assert by_keyword == by_position
    assert by_keyword.settings is settings
    assert list(draw.parameters()) == []


def test_what_a_rasterizer_is_made_with_comes_with_every_call():
    module = rasterizer()
    settings = module.GaussianRasterizationSettings("background", "viewmatrix", False)
    call = module.GaussianRasterizer(settings, profile=True)(1, 2, 3)
    assert call["profile"] is True


def test_visible_means_in_front_of_the_near_plane():
    module = rasterizer()
    view = torch.eye(4)
    view[3, 2] = 1.0  # one unit towards +z
    settings = module.GaussianRasterizationSettings(bg=None, viewmatrix=view, debug=False)
    points = torch.tensor([[0.0, 0, 0], [9, 9, -0.79], [0, 0, -0.81], [0, 0, -5]])
    visible = module.GaussianRasterizer(settings).markVisible(points)
    assert visible.tolist() == [True, True, False, False]
