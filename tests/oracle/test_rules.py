"""The host's rules, one by one: what is culled, where a splat may draw, when a pixel stops."""

import ast
import math
import sys
from dataclasses import replace
from pathlib import Path

import pytest
import scenes
import torch

import reference_renderer
from fragprune_plugins import constants
from fragprune_plugins.engines.reference import ReferenceEngine, camera_of, gaussians_of
from fragprune_plugins.errors import InputError
from reference_renderer import Options, covariance, project, scene
from reference_renderer.fragment import fragments

F64 = torch.float64


def draw(inputs, thresholds=None):
    return ReferenceEngine().rasterize(replace(inputs, counts=True, scores=True), thresholds)


def loss(drawn):
    sums = drawn.image.square().sum() + drawn.invdepth.sum() + drawn.alpha.sum()
    return sums + drawn.fragments_per_pixel


def test_only_torch_and_the_standard_library_are_imported():
    allowed = {"torch", "reference_renderer", *sys.stdlib_module_names}
    for path in Path(reference_renderer.__file__).parent.glob("*.py"):
        for node in ast.walk(ast.parse(path.read_text())):
            names = [a.name for a in node.names] if isinstance(node, ast.Import) else []
            names += [node.module] if isinstance(node, ast.ImportFrom) else []
            assert {name.split(".")[0] for name in names} <= allowed, path


def test_its_own_constants_are_those_of_the_core():
    defaults = Options()
    assert 1 / defaults.alpha_min == 255
    for name in ("DILATION", "NEAR", "ALPHA_MIN", "ALPHA_MAX", "TRANSMITTANCE_MIN"):
        assert getattr(defaults, name.lower()) == getattr(constants, name), name
    for module, names in (
        (scene, ("RIM_WIDTH", "RIM_REACH", "FALLOFF_MIN")),
        (covariance, ("FRUSTUM_MARGIN",)),
        (project, ("TILE", "ANTIALIASING_FLOOR", "MIP_FLOOR")),
    ):
        for name in names:
            assert getattr(module, name) == getattr(constants, name), name


@pytest.mark.parametrize("dtype", [torch.float32, F64])
@pytest.mark.parametrize("scene", [scenes.empty, scenes.behind_camera])
@pytest.mark.parametrize("thresholds", [False, True])
def test_where_nothing_is_drawn_the_background_alone_has_a_gradient(scene, dtype, thresholds):
    inputs, leaves = scenes.leaves(scene(dtype=dtype))
    count = len(inputs.splats)
    tau = torch.full((count,), 0.1, dtype=dtype, requires_grad=True) if thresholds else None
    drawn = draw(inputs, tau)
    loss(drawn).backward()
    background = inputs.view.background[:, None, None]
    assert torch.equal(drawn.image, background.expand_as(drawn.image))
    assert drawn.radii.tolist() == drawn.fragments_per_gaussian.tolist() == [0] * count
    assert drawn.evaluated_per_pixel == 0
    assert leaves.pop("background").grad.all()
    for name, leaf in (leaves | ({"tau": tau} if thresholds else {})).items():
        assert leaf.grad.shape == leaf.shape, name
        assert not leaf.grad.any(), name


def test_a_singular_footprint_is_rejected_and_breaks_no_gradient():
    flat = scenes.one_splat(sigma=(0.0, 0.0), dtype=F64)
    flat = replace(
        flat, dilation=0.0, splats=replace(flat.splats, scales=torch.zeros(1, 3).double())
    )
    inputs, leaves = scenes.leaves(replace(flat, compensation="antialiasing"))
    drawn = draw(inputs)
    loss(drawn).backward()
    assert drawn.radii.tolist() == [0]
    assert drawn.alpha.max() == 0
    assert all(leaf.grad.isfinite().all() for leaf in leaves.values())


@pytest.mark.parametrize(
    "x", [-40.0, -17.5, -7.0, -6.99, 0.0, 8.9, 9.0, 25.0, 39.0, 41.0, 46.9, 47, 60]
)
def test_tile_rectangle_is_the_hosts_integer_arithmetic(x):
    inputs = scenes.one_splat((x, 8.0), sigma=(2.0, 2.0), width=40, height=20, dtype=F64)
    camera = camera_of(inputs)
    prints = project.project(camera, gaussians_of(inputs.splats), Options())
    # Exactly at x, so that the boundary cases are those meant.
    prints = replace(prints, mean2d=torch.tensor([[x, 8.0]], dtype=F64))
    radius = int(prints.radius.item())
    x0 = min(3, max(0, int((x - radius) / 16)))
    x1 = min(3, max(0, int((x + radius + 15) / 16)))
    assert radius == 7
    assert project.tile_rects(camera, prints).tolist() == [[x0, 0, x1, 1]]


def columns_reached(x):
    inputs = scenes.one_splat(
        (x, 24.0), width=64, height=48, sigma=(5.0, 5.0), opacity=0.99, dtype=F64
    )
    drawn = draw(inputs)
    assert drawn.radii.tolist() == [16]
    return drawn.fragments.sum(0).nonzero()[:, 0].tolist()


def test_a_splat_is_drawn_beyond_three_sigma_inside_its_tiles_and_nowhere_outside():
    three_sigma, reach = 3 * math.sqrt(25.3), math.sqrt(25.3 * 2 * math.log(255 * 0.99))
    assert three_sigma < 16 < reach < 17
    # The square of radius 16 around 24 touches columns 0..47: alpha alone decides.
    assert columns_reached(24.0) == list(range(24 - 16, 24 + 16 + 1))
    # Around 16.9 it ends in column 31 though alpha reaches 33.
    assert columns_reached(16.9) == list(range(1, 32))


@pytest.mark.parametrize(
    ("opacities", "stop", "drawn", "left"),
    [
        # 0.1^3 times 0.05 is under 1e-4: there nothing is blended, nor behind, though it would do
        ([0.9, 0.9, 0.9, 0.95, 0.5], None, 3, 1e-3),
        ([0.9, 0.9, 0.9, 0.89, 0.5], None, 4, 1.1e-4),
        # a stop draws the fragment that crosses it, and none behind
        ([0.5, 0.5, 0.95, 0.5], 1.0, 1, 0.5),
        ([0.5, 0.5, 0.95, 0.5], 0.26, 2, 0.25),
        ([0.5, 0.5, 0.95, 0.5], 0.25, 3, 0.0125),
        ([0.5, 0.5, 0.95, 0.5], 0.0124, 4, 0.00625),
        ([0.5, 0.5, 0.95, 0.5], 1e-4, 4, 0.00625),
    ],
)
def test_a_pixel_ends_where_little_light_is_left(opacities, stop, drawn, left):
    inputs = replace(scenes.stack(opacities, dtype=F64), stop=stop)
    found = draw(inputs)
    assert found.fragments[8, 8] == drawn
    assert found.alpha[0, 8, 8].item() == pytest.approx(1 - left)
    alone = replace(inputs, stop=None, splats=gaussians_first(inputs.splats, drawn))
    assert torch.equal(draw(alone).image[:, 8, 8], found.image[:, 8, 8])


def test_a_negative_squared_distance_is_skipped_and_overflows_nothing():
    inputs = scenes.one_splat(dtype=F64)
    prints = project.project(camera_of(inputs), gaussians_of(inputs.splats), Options())
    conic = torch.tensor([[-9.0, 0.0, -9.0]], dtype=F64, requires_grad=True)
    pixels = torch.tensor([[8.0, 9.0], [20.0, 30.0]], dtype=F64)
    found = fragments(replace(prints, conic=conic), pixels, torch.tensor([0.1]).double(), Options())
    found.alpha.sum().backward()
    assert not found.drawn.any()
    assert not found.alpha.any()
    assert not conic.grad.any()


def test_a_stopped_fragment_gets_no_gradient():
    inputs, leaves = scenes.leaves(scenes.stack([0.9, 0.9, 0.9, 0.95, 0.5], dtype=F64))
    tau = torch.full((5,), 0.05, dtype=F64, requires_grad=True)
    drawn = draw(inputs, tau)
    (drawn.image[:, 8, 8].sum() + drawn.invdepth[0, 8, 8]).backward()
    for name in ("means", "opacities", "scales", "rotations", "colors"):
        assert not leaves[name].grad[3:].any(), name
    assert not tau.grad[3:].any()
    assert leaves["opacities"].grad[:3].all()


def test_cutting_an_earlier_fragment_lets_the_pixel_go_deeper():
    inputs = scenes.stack([0.9, 0.9, 0.9, 0.95, 0.5], dtype=F64)
    x = 11  # q = 9 / 4.3 from the mean: the falloff is 0.35
    open_, cut = torch.full((5,), 1e-9).double(), torch.tensor([0.5, 0.5, 0.5, 1e-9, 1e-9]).double()
    assert draw(inputs, open_).fragments[8, x] == 5
    assert draw(inputs, cut).fragments[8, x] == 2
    at_mean = torch.ones(5).double().mul(1e-9)
    at_mean[0] = 1.5  # larger than any falloff: nothing of the first is drawn
    assert draw(inputs, open_).fragments[8, 8] == 3
    assert draw(inputs, at_mean).fragments[8, 8] == 4
    assert draw(inputs, at_mean).fragments_per_gaussian[0] == 0


def test_antialiasing_dims_no_further_than_to_its_floor():
    thin = scenes.one_splat(sigma=(1e-9, 1e-9), opacity=0.8, dtype=F64)
    alpha = draw(replace(thin, compensation="antialiasing")).alpha[0, 8, 8].item()
    assert alpha == pytest.approx(0.8 * math.sqrt(2.5e-5))


def test_mip_leaves_out_what_is_too_small():
    # 1e-6 is the square of 0.001
    for side, dilation, draws in ((0.0316, 0.0, False), (0.0317, 0.0, True), (0.0316, 0.1, False)):
        small = scenes.one_splat(sigma=(side, side), opacity=0.9, dtype=F64)
        inputs, leaves = scenes.leaves(replace(small, compensation="mip", dilation=dilation))
        drawn = draw(inputs)
        assert (drawn.fragments.sum() > 0).item() is draws
        assert drawn.radii.item() > 0
        loss(drawn).backward()
        assert (leaves["opacities"].grad != 0).item() is draws
        assert all(leaf.grad.isfinite().all() for leaf in leaves.values())


@pytest.mark.parametrize("near", [0.0, 0.2, 2.5])
def test_the_near_plane_is_the_dialects(near):
    scene = replace(scenes.stack([0.5, 0.5, 0.5], dtype=F64), near=near)  # depths 2, 2.5, 3
    drawn = draw(scene)
    assert (drawn.radii > 0).tolist() == [near < 2, near < 2.5, True]
    assert drawn.fragments[8, 8] == 1 + (near < 2) + (near < 2.5)


def test_of_equal_weights_the_first_in_depth_order_wins():
    scene = scenes.footprints_of(scenes.stack([1 / 3, 0.25, 0.4], dtype=F64))
    scene.splats.means2d[:] = 8.0
    scene.splats.depths[:2] = torch.tensor([2.0, 1.0])  # 1/4 of the light, 1/3 of 3/4, 2/5 of 1/2
    drawn = draw(scene)
    assert drawn.winners[8, 8] == 1
    assert drawn.winners[0, 0] == -1
    assert drawn.wins_per_gaussian.sum() == (drawn.winners >= 0).sum()


def test_footprints_draw_what_the_splats_do_that_they_were_projected_from():
    for seed, kind in enumerate(({}, {"compensation": "mip"}, {"features": 3, "offsets": True})):
        scene = scenes.random_scene(seed, 60, 37, 21, dtype=F64, **kind)
        tau = scenes.random_thresholds(seed, 60, dtype=F64)
        whole, prints = draw(scene, tau), draw(scenes.footprints_of(scene), tau)
        for name in ("image", "invdepth", "alpha", "fragments", "fragments_per_gaussian"):
            assert torch.equal(getattr(whole, name), getattr(prints, name)), name
        assert not prints.radii.any()


def test_footprints_that_cannot_be_drawn_are_culled():
    scene = scenes.footprints_of(scenes.stack([0.5] * 5, dtype=F64))
    splats = scene.splats
    splats.conics[0, 0] = -1.0
    splats.conics[1, 1] = 9.0
    splats.depths[2] = 0.0
    splats.tiles[3] = torch.tensor([1, 1, 1, 2], dtype=torch.int32)
    drawn = draw(scene)
    assert (drawn.fragments_per_gaussian > 0).tolist() == [False, False, False, False, True]


@pytest.mark.parametrize(
    ("change", "said"),
    [
        *(({"near": near}, "near") for near in (-1.0, math.nan)),
        ({"alpha_max": 1.1}, "alpha_max"),
        *(({"stop": stop}, "stop") for stop in (0.0, 1.5, math.nan)),
        ({"stop": 0.01, "alpha_max": 1.0}, "alpha_max"),
        ({"compensation": "some"}, "compensation"),
        ({"rim": "round"}, "rim.*hard.*soft"),
        ({"planes": ("depth",)}, "planes"),
        ({"absolute_gradient": True, "means2d_hook": torch.zeros(40, 2)}, "means2d_hook"),
        ({"flat": True, "compensation": "mip"}, "surfels .* with compensation"),
        ({"flat": True, "absolute_gradient": True}, "surfels .* with absolute_gradient"),
        ({"flat": True, "offsets": True}, "surfels .* with sample_offsets"),
        ({"flat": True, "features": 2}, "with features"),
        ({"flat": True, "rim": "soft"}, "surfels.*soft rim"),
    ],
)
def test_inputs_of_no_dialect_are_refused(change, said):
    with pytest.raises(InputError, match=said):
        scenes.random_scene(1, 40, **change)


@pytest.mark.parametrize("channels", [0, 9])
def test_features_are_one_to_eight(channels):
    with pytest.raises(InputError, match="1 to 8"):
        replace(scenes.one_splat().splats, features=torch.zeros(1, channels))


def test_quaternions_are_used_as_given():
    base = scenes.random_scene(1, 8, dtype=F64)
    longer = replace(base, splats=replace(base.splats, rotations=base.splats.rotations * 1.2))
    assert not torch.allclose(draw(base).image, draw(longer).image)


def test_a_clamped_jacobian_coordinate_is_a_constant():
    x = torch.tensor([0.5, 3.0, -3.0], dtype=F64, requires_grad=True)
    z = torch.tensor([1.0, 2.0, 1.0], dtype=F64, requires_grad=True)
    clamped = covariance.clamp_to_frustum(x, z, 1.0)
    assert clamped.tolist() == pytest.approx([0.5, 2.6, -1.3])
    clamped.sum().backward()
    assert x.grad.tolist() == [1, 0, 0]
    assert z.grad is None or not z.grad.any()


@pytest.mark.parametrize("dtype", [torch.float32, F64])
def test_outputs_have_the_inputs_dtype_and_the_contracts_shapes(dtype):
    inputs = scenes.random_scene(2, 20, 33, 18, dtype=dtype)
    drawn = draw(inputs, scenes.random_thresholds(2, 20, dtype=dtype))
    assert drawn.image.dtype == drawn.invdepth.dtype == drawn.alpha.dtype == dtype
    assert drawn.fragments_per_pixel.dtype == dtype
    assert drawn.image.shape == (3, 18, 33)
    assert drawn.invdepth.shape == drawn.alpha.shape == (1, 18, 33)
    assert drawn.fragments.shape == (18, 33)
    integers = (drawn.radii, drawn.fragments, drawn.fragments_per_gaussian)
    assert {t.dtype for t in integers} == {torch.int32}
    assert ReferenceEngine().rasterize(inputs, None).fragments is None


def gaussians_first(splats, n):
    names = ("means", "opacities", "scales", "rotations", "colors")
    return replace(splats, **{name: getattr(splats, name)[:n] for name in names})
