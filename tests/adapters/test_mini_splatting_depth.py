"""Mini-Splatting's render_depth against its definition, pixel by pixel and fragment by fragment."""

import numpy as np
import pytest
import torch

from fragprune_mini_splatting.depth import render_depth
from fragprune_plugins.engines import create_engine
from fragprune_plugins.errors import InputError
from fragprune_plugins.types import RasterInputs, Splats, View

WIDTH, HEIGHT = 37, 21


def quaternions(count, generator):
    rotations = generator.normal(size=(count, 4))
    return rotations / np.linalg.norm(rotations, axis=1, keepdims=True)


def matrix(q):
    """Of a unit quaternion: v -> q v q*."""
    w, v = q[0], q[1:]
    cross = np.array([[0, -v[2], v[1]], [v[2], 0, -v[0]], [-v[1], v[0], 0]])
    return np.eye(3) + 2 * w * cross + 2 * cross @ cross


def scene(seed, near):
    """Gaussians before the camera; with ``near``, some so long that rays pass them behind it.

    Opacities stay below 0.35: no fragment outside the 3 sigma reaches 1/255.
    """
    generator = np.random.default_rng(seed)
    count = 14
    means = generator.uniform(-1, 1, (count, 3)) * (1.0, 0.6, 0.7) + (0, 0, 3)
    scales = np.exp(generator.uniform(-2.5, -0.8, (count, 3)))
    rotations = quaternions(count, generator)
    if near:
        means[:4] = generator.uniform(-1, 1, (4, 3)) * (0.4, 0.3, 0.1) + (0, 0, 0.5)
        scales[:4] = (1.5, 0.05, 0.05)
        turn = np.array([0.5, 0.65, 0.8, 0.95])  # about the y axis, nearly along the view
        rotations[:4] = np.stack([np.cos(turn), 0 * turn, np.sin(turn), 0 * turn], axis=1)
    return means, scales, rotations, generator.uniform(0.05, 0.35, count)


def inputs_of(means, scales, rotations, opacities, colours):
    turn = torch.from_numpy(matrix(np.array([0.96, 0.1, -0.2, 0.05]) / 0.9872)).float()
    place = torch.tensor([0.2, -0.1, 0.3])
    view = View.pinhole(turn, place, width=WIDTH, height=HEIGHT, fx=30.0, fy=28.0)
    world = (
        torch.from_numpy(means).float() - place
    ) @ turn  # means are given in the camera's frame
    return RasterInputs(
        view=view,
        splats=Splats(
            means=world,
            opacities=torch.from_numpy(opacities).float(),
            scales=torch.from_numpy(scales).float(),
            rotations=torch.from_numpy(rotations).float(),
            colors=torch.from_numpy(colours).float(),
        ),
        counts=True,
        scores=True,
    )


def expected(inputs, thresholds):
    """The definition: front to back, a fragment whose middle lies behind neither wins nor hides."""
    s, v = inputs.splats, inputs.view
    turn, place = v.viewmatrix[:3, :3].numpy().astype(float), v.viewmatrix[3, :3].numpy()
    eye = v.campos.numpy().astype(float)
    focal = WIDTH / 2 / v.tan_fov_x, HEIGHT / 2 / v.tan_fov_y
    order, flat = [], {}
    for i in range(len(s.means)):
        local = s.means[i].numpy().astype(float) @ turn + place
        if local[2] <= 0.2:
            continue
        axes = matrix(s.rotations[i].numpy().astype(float)) * s.scales[i].numpy().astype(float)
        x, y = (
            np.clip(local[k] / local[2], -1.3 * t, 1.3 * t) * local[2]
            for k, t in ((0, v.tan_fov_x), (1, v.tan_fov_y))
        )
        to_screen = np.array(
            [
                [focal[0] / local[2], 0, -focal[0] * x / local[2] ** 2],
                [0, focal[1] / local[2], -focal[1] * y / local[2] ** 2],
            ]
        )
        axes2d = to_screen @ turn.T @ axes
        conic = np.linalg.inv(axes2d @ axes2d.T + 0.3 * np.eye(2))
        centre = np.array(
            [
                focal[0] * local[0] / local[2] + WIDTH / 2 - 0.5,
                focal[1] * local[1] / local[2] + HEIGHT / 2 - 0.5,
            ]
        )
        flat[i] = centre, conic, axes / s.scales[i].numpy() ** 2 / 3
        order.append((local[2], i))
    out = {
        name: np.zeros((HEIGHT, WIDTH)) for name in ("rendered_depth", "discriminants", "gidx")
    } | {"accum_alpha": np.ones((HEIGHT, WIDTH)), "out_pts": np.zeros((HEIGHT, WIDTH, 3))}
    behind = np.zeros((HEIGHT, WIDTH), dtype=bool)
    for row in range(HEIGHT):
        for column in range(WIDTH):
            ray = np.array(
                [
                    ((2 * column + 1) / WIDTH - 1) * v.tan_fov_x,
                    ((2 * row + 1) / HEIGHT - 1) * v.tan_fov_y,
                    1,
                ]
            )
            direction = turn @ ray
            length = np.linalg.norm(direction)
            left, most = 1.0, 0.0
            for _, i in sorted(order):
                centre, conic, whiten = flat[i]
                offset = centre - (column, row)
                falloff = np.exp(-0.5 * offset @ conic @ offset)
                alpha = float(s.opacities[i]) * falloff
                if alpha < 1 / 255 or falloff < float(thresholds[i]):
                    continue
                u = whiten.T @ (direction / length)
                w = whiten.T @ (eye - s.means[i].numpy())
                a, b, c = u @ u, 2 * (u @ w), w @ w - 1
                way = -b / 2 / a
                if way < 0:
                    behind[row, column] = True
                    continue
                if alpha * left > most:
                    most = alpha * left
                    out["gidx"][row, column] = i
                    out["rendered_depth"][row, column] = way / length
                    out["discriminants"][row, column] = b * b - 4 * a * c
                    out["out_pts"][row, column] = eye + way * direction / length
                left *= 1 - alpha
            out["accum_alpha"][row, column] = left
    return out, behind


@pytest.mark.parametrize("engine", ["reference", "cpu"])
@pytest.mark.parametrize("near", [False, True])
@pytest.mark.parametrize("threshold", [1e-6, 0.2])
def test_points_lie_where_the_heaviest_gaussian_is_met(near, threshold, engine):
    generator = np.random.default_rng(5)
    seen = 0
    for seed in range(3):
        parts = scene(seed, near)
        inputs = inputs_of(*parts, generator.uniform(size=(len(parts[0]), 3)))
        thresholds = torch.full((len(parts[0]),), threshold)
        rasterize = create_engine(engine).rasterize
        have = render_depth(inputs, lambda each, t=thresholds, r=rasterize: r(each, t))
        want, behind = expected(inputs, thresholds)
        seen += int(behind.sum())
        left = have["accum_alpha"][0].numpy()
        # A fragment may fall on either side of a cut, two weights may be equal, by rounding.
        same = (np.abs(left - want["accum_alpha"]) < 1e-4) & (
            have["gidx"][0].numpy() == want["gidx"]
        )
        assert (~same).sum() <= 3
        points = have["out_pts"].permute(1, 2, 0).numpy()
        assert np.abs(points - want["out_pts"])[same].max() < 2e-4  # world units, float32 of metres
        assert np.abs(have["rendered_depth"][0].numpy() - want["rendered_depth"])[same].max() < 2e-4
        scale = 1 + np.abs(want["discriminants"])
        assert (np.abs(have["discriminants"][0].numpy() - want["discriminants"]) / scale)[
            same
        ].max() < 1e-3
        shapes = {name: tuple(picture.shape[1:]) for name, picture in have.items()}
        assert set(shapes.values()) == {(HEIGHT, WIDTH)}
    assert (seen > 50) == near


def test_where_nothing_is_drawn_there_is_no_point_and_all_of_the_transmittance():
    means, scales, rotations, opacities = scene(0, near=False)
    inputs = inputs_of(means - (0, 0, 9), scales, rotations, opacities, means)
    rasterize = create_engine("reference").rasterize
    have = render_depth(inputs, lambda each: rasterize(each, None))
    assert (have["accum_alpha"] == 1).all()
    for name in ("out_pts", "rendered_depth", "discriminants", "gidx"):
        assert not have[name].any()


def test_covariances_in_place_of_scales_are_refused():
    splats = Splats(
        means=torch.zeros(1, 3),
        opacities=torch.ones(1) / 2,
        cov3d=torch.tensor([[1.0, 0, 0, 1, 0, 1]]),
        colors=torch.ones(1, 3),
    )
    view = View.pinhole(torch.eye(3), torch.zeros(3), width=4, height=4, fx=4.0, fy=4.0)
    with pytest.raises(InputError, match="compute_cov3D_python"):
        render_depth(RasterInputs(view, splats), None)
