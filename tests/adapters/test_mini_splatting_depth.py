"""Mini-Splatting's render_depth against its definition, pixel by pixel and fragment by fragment."""

import numpy as np
import pytest
import torch
from oracle import naive

from fragprune_mini_splatting.depth import render_depth
from fragprune_plugins.adapting import InputError, RasterInputs, Splats, View
from fragprune_plugins.engines import create_engine

WIDTH, HEIGHT = 37, 21


def quaternions(count, generator):
    rotations = generator.normal(size=(count, 4))
    return rotations / np.linalg.norm(rotations, axis=1, keepdims=True)


def matrix(quaternion):
    """Of a unit quaternion."""
    return np.stack([naive.rotate(quaternion.tolist(), axis) for axis in np.eye(3)], axis=1)


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
    turn, eye = v.viewmatrix[:3, :3].numpy().astype(float), v.campos.numpy().astype(float)
    shapes = zip(s.rotations.numpy().astype(float), s.scales.numpy().astype(float), strict=True)
    whiten = [matrix(rotation) / scales / 3 for rotation, scales in shapes]
    away = eye - s.means.numpy()
    names = ("rendered_depth", "discriminants", "gidx", "accum_alpha")
    out = {name: np.zeros((HEIGHT, WIDTH)) for name in names}
    out["out_pts"] = np.zeros((HEIGHT, WIDTH, 3))
    behind, splats = np.zeros((HEIGHT, WIDTH), dtype=bool), naive.splats_of(inputs, thresholds)
    for row, column in np.ndindex(HEIGHT, WIDTH):
        across = ((2 * column + 1) / WIDTH - 1) * v.tan_fov_x
        direction = turn @ np.array([across, ((2 * row + 1) / HEIGHT - 1) * v.tan_fov_y, 1])
        length = np.linalg.norm(direction)
        left, most = 1.0, 0.0
        for record in naive.records_at(splats, column, row)[0]:
            if not record.drawn:
                continue
            i = record.row
            u = whiten[i].T @ (direction / length)
            w = whiten[i].T @ away[i]
            a, b, c = u @ u, 2 * (u @ w), w @ w - 1
            way = -b / 2 / a
            if way < 0:
                behind[row, column] = True
                continue
            if record.alpha * left > most:
                most = record.alpha * left
                out["gidx"][row, column] = i
                out["rendered_depth"][row, column] = way / length
                out["discriminants"][row, column] = b * b - 4 * a * c
                out["out_pts"][row, column] = eye + way * direction / length
            left *= 1 - record.alpha
        out["accum_alpha"][row, column] = left
    return out, behind


@pytest.mark.parametrize("near", [False, True])
@pytest.mark.parametrize("threshold", [1e-6, 0.2])
def test_points_lie_where_the_heaviest_gaussian_is_met(near, threshold):
    generator = np.random.default_rng(5)
    seen = 0
    for seed in range(3):
        parts = scene(seed, near)
        inputs = inputs_of(*parts, generator.uniform(size=(len(parts[0]), 3)))
        thresholds = torch.full((len(parts[0]),), threshold)
        want, behind = expected(inputs, thresholds)
        seen += int(behind.sum())
        for name in ("reference", "cpu"):
            engine = create_engine(name)
            drawn = render_depth(inputs, lambda x, e=engine, t=thresholds: e.rasterize(x, t))
            expect_same({name: values.numpy() for name, values in drawn.items()}, want)
    assert (seen > 50) == near


def expect_same(have, want):
    """But where a fragment falls on either side of a cut, or two weights are equal, by rounding."""
    assert {values.shape[1:] for values in have.values()} == {(HEIGHT, WIDTH)}
    away = {
        name: np.abs(values.transpose(1, 2, 0) - want[name].reshape(HEIGHT, WIDTH, -1))
        for name, values in have.items()
        if name in want
    }
    same = ((away["accum_alpha"] < 1e-4) & (away["gidx"] == 0))[..., 0]
    assert (~same).sum() <= 3
    for name in ("out_pts", "rendered_depth"):  # world units, float32 of metres
        assert away[name][same].max() < 2e-4
    scale = 1 + np.abs(want["discriminants"])[..., None]
    assert (away["discriminants"] / scale)[same].max() < 1e-3


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
