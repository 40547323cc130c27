"""Surfels against geometry: rays, planes and points in the world, none of the oracle's matrices."""

import math
from dataclasses import dataclass, replace
from functools import partial

import numpy as np
import pytest
import scenes
import torch
from oracle.naive import color_of, rotate
from oracle.test_gradients import smooth_surfels, uncut

from fragprune_plugins.engines.reference import ReferenceEngine, camera_of, gaussians_of
from reference_renderer import render
from reference_renderer.surfel import meet

F64 = torch.float64
NEAR, FAR = 0.2, 100.0


@dataclass
class Disc:
    """A surfel and its fragments at all pixels."""

    row: int
    depth: float
    normal: np.ndarray
    q: np.ndarray
    z: np.ndarray
    inside: np.ndarray
    radius: int


def lens(view):
    """World to camera, and the rays of all pixels at view depth 1."""
    matrix = view.viewmatrix.numpy()
    x = (2 * np.arange(view.width) + 1) / view.width - 1
    y = (2 * np.arange(view.height) + 1) / view.height - 1
    columns, rows = np.meshgrid(x * view.tan_fov_x, y * view.tan_fov_y)
    return matrix, np.stack([columns, rows, np.ones_like(rows)], axis=-1)


def discs(inputs):
    view, splats = inputs.view, inputs.splats
    matrix, rays = lens(view)
    pixels = np.stack(np.meshgrid(np.arange(view.width), np.arange(view.height)), axis=-1)
    size = np.array([view.width, view.height])
    found = []
    for row in range(len(splats)):
        mean = splats.means[row].numpy() @ matrix[:3, :3] + matrix[3, :3]
        if mean[2] <= NEAR:
            continue
        turned = partial(rotate, splats.rotations[row].tolist())
        u, v, normal = (turned(axis) @ matrix[:3, :3] for axis in np.eye(3))
        long, wide = inputs.scale_modifier * splats.scales[row].numpy()
        u, v = long * u, wide * v
        normal = normal if normal @ mean < 0 else -normal
        with np.errstate(divide="ignore", invalid="ignore"):
            t = (mean @ normal) / (rays @ normal)
            at = rays * t[..., None] - mean
            on_plane = ((at @ u) / (u @ u)) ** 2 + ((at @ v) / (v @ v)) ** 2
        # The bounding box of the rim at three standard deviations, from points of it.
        angle = np.linspace(0, 2 * np.pi, 10_000)[:, None]
        rim = mean + 3 * (np.cos(angle) * u + np.sin(angle) * v)
        assert (rim[:, 2] > 0).all()  # beyond, the host's box is no box
        flat = rim[:, :2] / rim[:, 2:] / [view.tan_fov_x, view.tan_fov_y]
        flat = ((flat + 1) * size - 1) / 2
        low, high = flat.min(axis=0), flat.max(axis=0)
        centre = (low + high) / 2
        radius = math.ceil(max(*(high - low) / 2, 3 / math.sqrt(2)))
        filtered = 2 * ((pixels - centre) ** 2).sum(axis=-1)
        tile = pixels // 16
        inside = (tile >= np.maximum((centre - radius) // 16, 0)) & (
            tile < (centre + radius + 15) // 16
        )
        found.append(
            Disc(
                row=row,
                depth=mean[2],
                normal=normal,
                q=np.minimum(on_plane, filtered),
                z=t,
                inside=inside.all(axis=-1) & (t >= NEAR),
                radius=radius,
            )
        )
    return sorted(found, key=lambda disc: disc.depth)


def blend(inputs, thresholds):
    """Image, alpha, counts and surface, pixel by pixel, pair by pair."""
    view, splats = inputs.view, inputs.splats
    sorted_discs = discs(inputs)
    image = np.zeros((3, view.height, view.width))
    alpha, counts = np.zeros(image.shape[1:]), np.zeros(image.shape[1:], dtype=int)
    surface = np.zeros((6, *image.shape[1:]))
    colors = {disc.row: color_of(splats, disc.row, view.campos.tolist()) for disc in sorted_discs}
    for y in range(view.height):
        for x in range(view.width):
            light, kept = 1.0, []
            for disc in sorted_discs:
                falloff = math.exp(-disc.q[y, x] / 2)
                a = min(0.99, splats.opacities[disc.row].item() * falloff)
                tau = 0.0 if thresholds is None else thresholds[disc.row].item()
                if not disc.inside[y, x] or a < 1 / 255 or falloff < tau:
                    continue
                if light < (inputs.stop or 0) or (not inputs.stop and light * (1 - a) < 1e-4):
                    break
                if light > 0.5:
                    surface[4, y, x] = disc.z[y, x]
                kept.append((a * light, disc))
                light *= 1 - a
            counts[y, x], alpha[y, x] = len(kept), 1 - light
            for weight, disc in kept:
                image[:, y, x] += weight * np.array(colors[disc.row])
                surface[0, y, x] += weight * disc.z[y, x]
                surface[1:4, y, x] += weight * disc.normal
            depths = [FAR / (FAR - NEAR) * (1 - NEAR / disc.z[y, x]) for _, disc in kept]
            for i, (one, _) in enumerate(kept):
                for j, (other, _) in enumerate(kept[:i]):
                    surface[5, y, x] += one * other * (depths[i] - depths[j]) ** 2
            image[:, y, x] += light * view.background.numpy()
    return image, alpha, counts, surface, {disc.row: disc.radius for disc in sorted_discs}


def in_front(seed, n, width, height, **kind):
    """Surfels whose three standard deviations are in front of the camera."""
    scene = scenes.random_scene(seed, n, width, height, flat=True, dtype=F64, **kind)
    matrix = scene.view.viewmatrix
    depth = (scene.splats.means @ matrix[:3, :3] + matrix[3, :3])[:, 2]
    reach = 3 * scene.scale_modifier * scene.splats.scales.norm(dim=1)
    rows = (depth - reach > NEAR) | (depth <= NEAR)
    given = {k: v[rows] if torch.is_tensor(v) else v for k, v in vars(scene.splats).items()}
    return replace(scene, splats=type(scene.splats)(**given))


@pytest.mark.parametrize("truncated", [False, True], ids=["whole", "truncated"])
@pytest.mark.parametrize(
    "kind", [{}, {"sh_degree": 3}, {"colors": True, "scale_modifier": 1.4}, {"stop": 0.3}], ids=str
)
def test_every_output_is_that_of_rays_and_planes(kind, truncated):
    scene = in_front(3, 30, 34, 12, **kind)
    assert len(scene.splats) > 18
    tau = scenes.random_thresholds(5, len(scene.splats), dtype=F64) if truncated else None
    image, alpha, counts, surface, radii = blend(scene, tau)
    drawn = ReferenceEngine().rasterize(replace(scene, counts=True), tau)
    assert np.array_equal(drawn.fragments.numpy(), counts)
    assert counts.max() > 3
    # The rim's box is found to 1e-7 of its size; depths go to 13.
    for one, expected in ((drawn.image, image), (drawn.alpha[0], alpha), (drawn.surface, surface)):
        assert one.numpy() == pytest.approx(expected, abs=3e-6)
    touching = {row: radius for row, radius in radii.items() if drawn.radii[row] > 0}
    assert {row: int(drawn.radii[row]) for row in touching} == touching
    assert set(drawn.fragments_per_gaussian.nonzero()[:, 0].tolist()) <= set(touching)


def test_a_threshold_draws_what_lies_within_its_radius_on_the_plane():
    """A surfel seen at 60 degrees: the ellipse is that of the plane, not of the image."""
    half = math.radians(60) / 2
    scene = scenes.one_splat((20.0, 20.0), width=41, height=41, sigma=(6.0, 6.0), dtype=F64)
    turned = torch.tensor([[math.cos(half), 0.0, math.sin(half), 0.0]], dtype=F64)
    splats = replace(scenes.flattened(scene.splats), rotations=turned)
    tau = torch.tensor([0.4], dtype=F64)
    counts = ReferenceEngine().rasterize(replace(scene, splats=splats, counts=True), tau).fragments
    (disc,) = discs(replace(scene, splats=splats))
    assert torch.equal(counts.bool(), torch.from_numpy(disc.q <= -2 * math.log(0.4)))
    across, down = counts.any(dim=0).sum(), counts.any(dim=1).sum()
    assert int(down) == 17  # 2 * 1.35 * 6
    assert 8 <= int(across) <= 10  # half of it, in perspective


def test_the_hooks_gradient_is_the_means_along_the_screen():
    """Moving the plane by one pixel of its centre, in units of half a picture."""
    scene, leaves = scenes.leaves(smooth_surfels(colors=True, flat=True))
    options = uncut(scene)
    camera, gaussians = camera_of(scene), gaussians_of(scene.splats)
    drawn = render(camera, gaussians, means2d_hook=scene.means2d_hook, options=options)
    weight = torch.randn(drawn.image.shape, generator=torch.Generator().manual_seed(0), dtype=F64)
    (drawn.image * weight).sum().backward()
    hook, means = leaves["means2d_hook"].grad, leaves["means"].grad
    depth = torch.tensor([2.0, 3.0, 4.0], dtype=F64)
    tan = torch.tensor([scene.view.tan_fov_x, scene.view.tan_fov_y], dtype=F64)
    torch.testing.assert_close(hook[:, :2], means[:, :2] * depth[:, None] * tan)
    assert not hook[:, 2].any()


def test_where_the_round_gaussian_is_nearer_depth_feels_the_plane_but_not_the_point():
    plane = torch.tensor([[[2.0, 0.5, 8.0], [0.1, 3.0, 6.0], [0.2, 0.1, 2.0]]], dtype=F64)
    plane.requires_grad_()
    pixel = torch.tensor([[5.0, 4.0]], dtype=F64)
    for filtered, moves in ((1e-9, False), (1e9, True)):
        plane.grad = None
        q, depth = meet(plane, pixel, torch.full((1, 1), filtered, dtype=F64), NEAR)
        depth.sum().backward()
        assert bool(plane.grad[0, :2].any()) == moves
        assert plane.grad[0, 2, 2] == 1 or moves
    assert q.item() != filtered
