"""Derivatives: by finite differences with the cuts off, and the host's own quirks with them on."""

from dataclasses import replace
from functools import partial

import pytest
import scenes
import torch

from fragprune_plugins.engines.reference import (
    ReferenceEngine,
    camera_of,
    gaussians_of,
    options_of,
    projected_of,
)
from reference_renderer import Options, render, render_footprints
from reference_renderer.sh import sh_colors

F64 = torch.float64
# A random direction of inputs against one of outputs: entry by entry takes 30 times as long.
gradcheck = partial(torch.autograd.gradcheck, eps=1e-6, atol=1e-5, rtol=1e-4, fast_mode=True)


def uncut(inputs) -> Options:
    """The dialect with every cut off: differentiable everywhere."""
    options = options_of(inputs)
    return replace(options, alpha_min=0, transmittance_min=0, tiles=False, rim="surrogate")


def smooth_scene(n=3, **kind):
    """Splats inside a small image, none capped, clamped or culled."""
    made = scenes.random_scene(7, n, 9, 7, dtype=F64, **kind)
    at = torch.tensor([[2.2, 3.1], [5.7, 2.4], [4.1, 4.9]]).double()[:n]
    depths = torch.tensor([2.0, 3.0, 4.0]).double()[:n]
    splats = replace(
        made.splats,
        means=scenes.unproject(made.view, at, depths),
        opacities=torch.tensor([0.5, 0.8, 0.3]).double()[:n],
    )
    if splats.sh is not None:
        splats = replace(splats, sh=splats.sh * 0.2)
    return replace(made, splats=splats)


def smooth_surfels(**kind):
    """Surfels inside a small image, none capped or culled, their centres between pixels.

    So no pixel is nearer to a round Gaussian than to a plane, where depths have other derivatives.
    """
    made = scenes.random_scene(7, 3, 9, 7, dtype=F64, **kind)
    view = scenes.one_splat(width=9, height=7, dtype=F64).view  # the world is the camera's
    at = torch.tensor([[2.27, 3.69], [5.2, 1.88], [3.62, 5.03]], dtype=F64)
    depths = torch.tensor([2.0, 3.0, 4.0], dtype=F64)
    per_pixel = depths * 2 * view.tan_fov_x / 9
    turns = torch.tensor([[1, 0.1, 0.05, 0.3], [1, -0.1, 0.1, 0], [0.9, 0.1, -0.1, 0.6]], dtype=F64)
    splats = replace(
        made.splats,
        means=scenes.unproject(view, at, depths),
        opacities=torch.tensor([0.5, 0.8, 0.3], dtype=F64),
        scales=torch.tensor([[1.6, 1.2], [1.2, 1.8], [1.5, 1.5]], dtype=F64)
        * per_pixel[:, None]
        / made.scale_modifier,
        rotations=torch.nn.functional.normalize(turns),
    )
    if splats.sh is not None:
        splats = replace(splats, sh=splats.sh * 0.2)
    return replace(made, view=view, splats=splats)


def outputs(drawn):
    made = drawn.image, drawn.invdepth, drawn.alpha, drawn.fragments_per_pixel
    made = (*made, drawn.features, drawn.surface)
    return tuple(tensor for tensor in made if tensor is not None)


KINDS = {
    "sh degree 0": {"sh_degree": 0},
    "sh degree 1": {"sh_degree": 1},
    "sh degree 3": {"sh_degree": 3},
    "colours and covariances": {"colors": True, "cov3d": True},
    "antialiased": {"colors": True, "compensation": "antialiasing"},
    "mip": {"colors": True, "compensation": "mip"},
    "mip, covariances": {"cov3d": True, "compensation": "mip", "sh_degree": 0},
    "features at offsets": {"colors": True, "features": 3, "offsets": True},
    "scaled": {"colors": True, "scale_modifier": 1.3},
    "surfels": {"colors": True, "flat": True},
    "surfels, sh, scaled": {"sh_degree": 2, "scale_modifier": 1.3, "flat": True},
}


@pytest.mark.parametrize(
    ("kind", "rim"),
    [
        *((kind, "surrogate") for kind in KINDS),
        *((kind, "soft") for kind in ("sh degree 1", "mip, covariances", "features at offsets")),
        *((kind, None) for kind in ("sh degree 3", "antialiased", "scaled", "surfels")),
    ],
)
def test_every_input_has_the_derivative_of_finite_differences(kind, rim):
    smooth = smooth_surfels if "flat" in KINDS[kind] else smooth_scene
    scene, leaves = scenes.leaves(smooth(**KINDS[kind]))
    truncated, options = rim is not None, replace(uncut(scene), rim=rim or "hard")
    hook = leaves.pop("means2d_hook")
    names = list(leaves)
    tau = torch.tensor([0.3, 0.6, 0.1], dtype=F64, requires_grad=truncated)

    def drawn(*tensors):
        given = dict(zip(names, tensors[:-1], strict=True))
        camera = replace(camera_of(scene), background=given.pop("background"))
        gaussians = replace(gaussians_of(scene.splats), **given)
        thresholds = tensors[-1] if truncated else None
        made = outputs(render(camera, gaussians, thresholds, means2d_hook=hook, options=options))
        # But for the surrogate a count is a constant.
        return made if rim == "surrogate" else made[:3] + made[4:]

    assert gradcheck(drawn, (*leaves.values(), tau))


def test_what_a_stop_leaves_out_has_the_derivatives_of_a_look_alike_of_the_last_fragment():
    scene, leaves = scenes.leaves(replace(smooth_scene(colors=True), stop=0.52))
    hook = leaves.pop("means2d_hook")
    names, options = list(leaves), uncut(scene)

    def drawn(*tensors):
        given = dict(zip(names, tensors, strict=True))
        camera = replace(camera_of(scene), background=given.pop("background"))
        return render(
            camera, replace(gaussians_of(scene.splats), **given), means2d_hook=hook, options=options
        )

    first = drawn(*leaves.values())
    assert {1, 2, 3} <= set(first.fragments.flatten().tolist())
    splats, stopped = scene.splats, 1 - first.alpha.detach() < scene.stop
    depth = (splats.means @ scene.view.viewmatrix[:3, :3] + scene.view.viewmatrix[3, :3])[:, 2]
    last = depth.argsort()[first.fragments.long() - 1]
    color, behind = splats.colors[last].movedim(-1, 0), scene.view.background[:, None, None]
    added = (color - behind).detach(), (1 / depth)[last][None].detach(), torch.ones_like(last)

    def filled(*tensors):
        made = drawn(*tensors)
        left = torch.where(stopped, 1 - made.alpha, 0).detach()
        return tuple(  # these values, with the derivatives as they are given
            value + left * more for value, more in zip(outputs(made)[:3], added, strict=True)
        )

    assert gradcheck(filled, tuple(leaves.values()))


@pytest.mark.parametrize("features", [0, 2])
def test_every_number_of_a_footprint_has_the_derivative_of_finite_differences(features):
    made = scenes.footprints_of(smooth_scene(colors=True, features=features))
    scene, leaves = scenes.leaves(made)
    del leaves["means2d_hook"]
    names = list(leaves)
    tau = torch.tensor([0.3, 0.6, 0.1], dtype=F64, requires_grad=True)

    def drawn(*tensors):
        given = dict(zip(names, tensors[:-1], strict=True))
        camera = replace(camera_of(scene), background=given.pop("background"))
        prints = projected_of(replace(scene.splats, **given))
        options = uncut(scene)
        return outputs(
            render_footprints(camera, prints, scene.splats.tiles, tensors[-1], options=options)
        )

    assert gradcheck(drawn, (*leaves.values(), tau))


def hook_gradient(inputs, weight):
    made, leaves = scenes.leaves(inputs)
    drawn = ReferenceEngine().rasterize(made, None)
    (torch.cat([drawn.image, drawn.alpha]) * weight).sum().backward()
    return leaves["means2d_hook"].grad


def test_the_absolute_gradient_is_the_sum_of_what_single_pixels_add():
    scene = scenes.random_scene(3, 30, 19, 9, colors=True, dtype=F64, offsets=True)
    weight = torch.randn(4, 9, 19, generator=torch.Generator().manual_seed(0), dtype=F64)
    expected = torch.zeros(30, dtype=F64)
    for y in range(9):
        for x in range(19):
            alone = torch.zeros_like(weight)
            alone[:, y, x] = weight[:, y, x]
            expected += hook_gradient(scene, alone)[:, :2].abs().sum(dim=1)
    asked = hook_gradient(replace(scene, absolute_gradient=True), weight)
    plain = hook_gradient(scene, weight)
    assert torch.allclose(asked[:, 2], expected, rtol=1e-10, atol=1e-12)
    assert torch.allclose(asked[:, :2], plain[:, :2], rtol=1e-12, atol=1e-12)
    assert expected.max() > 1.1 * plain[:, :2].abs().sum(dim=1).max()
    assert not plain[:, 2].any()


@pytest.mark.parametrize(("alpha_max", "passes"), [(0.99, True), (0.99, False), (0.5, False)])
def test_the_caps_gradient_passes_or_stops(alpha_max, passes):
    scene = scenes.one_splat(opacity=0.999, color=(1.0, 1.0, 1.0), dtype=F64)
    scene = replace(scene, alpha_max=alpha_max, cap_gradient=passes)
    inputs, leaves = scenes.leaves(scene)
    drawn = ReferenceEngine().rasterize(inputs, None)
    assert drawn.image[0, 8, 8].item() == pytest.approx(alpha_max)
    drawn.image[0, 8, 8].backward()
    assert leaves["opacities"].grad.item() == (1 if passes else 0)


@pytest.mark.parametrize("axis", [0, 1])
def test_the_means2d_gradient_is_that_of_normalised_device_coordinates(axis):
    scene, leaves = scenes.leaves(smooth_scene(1, colors=True))
    weight = torch.rand(3, 7, 9, generator=torch.Generator().manual_seed(0), dtype=F64)

    def loss(shift, hook=None):
        # clip.w times the shift, added to clip.x or .y, moves the image by the shift in NDC and
        # leaves the covariance alone.
        clip = scene.view.projmatrix
        unit = torch.eye(4, dtype=F64)[axis]
        camera = replace(camera_of(scene), projmatrix=clip + shift * clip[:, 3:] * unit)
        options = uncut(scene)
        drawn = render(camera, gaussians_of(scene.splats), means2d_hook=hook, options=options)
        return (drawn.image * weight).sum()

    hook = leaves["means2d_hook"]
    loss(0.0, hook).backward()
    h = 1e-6
    slope = (loss(h) - loss(-h)).item() / (2 * h)
    assert hook.grad[0, axis].item() == pytest.approx(slope, rel=1e-6)
    assert hook.grad[0, 2] == 0


def test_the_means2d_hooks_values_are_unused():
    scene = scenes.random_scene(2, 20, dtype=F64)
    values = torch.randn(20, 3, generator=torch.Generator().manual_seed(0), dtype=F64)
    plain = ReferenceEngine().rasterize(scene, None)
    hooked = ReferenceEngine().rasterize(replace(scene, means2d_hook=values), None)
    assert torch.equal(plain.image, hooked.image)


@pytest.mark.parametrize("dtype", [torch.float32, F64])
def test_gradients_of_an_awkward_scene_are_finite_and_zero_where_culled(dtype):
    inputs, leaves = scenes.leaves(scenes.random_scene(9, 120, 48, 40, dtype=dtype))
    tau = scenes.random_thresholds(9, 120, dtype=dtype).requires_grad_()
    drawn = ReferenceEngine().rasterize(inputs, tau)
    (drawn.image.square().sum() + drawn.invdepth.sum() + drawn.fragments_per_pixel).backward()
    culled = drawn.radii == 0
    assert culled.any()
    background = leaves.pop("background")
    assert background.grad.isfinite().all()
    for name, leaf in {**leaves, "tau": tau}.items():
        assert leaf.grad.isfinite().all(), name
        assert not leaf.grad[culled].any(), name
        assert leaf.grad[~culled].any(), name


def test_a_channel_clamped_at_zero_gets_no_gradient():
    sh = torch.tensor([[[-3.0, 1.0, 0.0]]], dtype=F64, requires_grad=True)
    colors = sh_colors(torch.tensor([[0.0, 0.6, 0.8]]).double(), torch.zeros(3).double(), sh, 0)
    colors.sum().backward()
    assert colors[0, 0] == 0
    assert sh.grad[0, 0].tolist() == pytest.approx([0, 0.28209479, 0.28209479])
