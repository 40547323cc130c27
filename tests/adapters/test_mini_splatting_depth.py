"""Mini-Splatting's render_depth against its definition, pixel by pixel and fragment by fragment."""

from dataclasses import replace

import numpy as np
import pytest
import scenes
import torch
from oracle import naive

from fragprune_mini_splatting.depth import render_depth
from fragprune_plugins.adapting import InputError, RasterInputs, Splats, View
from fragprune_plugins.engines import create_engine

WIDTH, HEIGHT = 37, 21


def matrix(quaternion):
    """Of a unit quaternion."""
    return np.stack([naive.rotate(quaternion.tolist(), axis) for axis in np.eye(3)], axis=1)


def scene(seed, near):
    """Gaussians before a turned camera; with ``near``, some so long that rays pass them behind it.

    Opacities stay below 0.35: no fragment outside the 3 sigma reaches 1/255.
    """
    inputs = scenes.random_scene(seed, 14, WIDTH, HEIGHT, colors=True)
    splats = inputs.splats
    splats.opacities.mul_(0.35)
    if near:
        pixels = torch.tensor([[18.0, 10.0], [9.0, 14.0], [28.0, 5.0], [20.0, 16.0]])
        splats.means[:4] = scenes.unproject(inputs.view, pixels, torch.linspace(0.4, 0.6, 4))
        splats.scales[:4] = torch.tensor([1.5, 0.05, 0.05])
        tilt = torch.tensor([[0.0, 0.6, 0.1], [0.4, 0.0, 0.3], [0.0, -0.3, 0.4], [-0.5, 0.2, 0.0]])
        ahead = torch.nn.functional.normalize(inputs.view.viewmatrix[:3, 2] + tilt, dim=1)
        side = torch.tensor([1.0, 0, 0]).expand(4, 3)  # the long axis, turned ahead
        halfway = torch.cat([1 + ahead[:, :1], torch.linalg.cross(side, ahead)], dim=1)
        splats.rotations[:4] = torch.nn.functional.normalize(halfway, dim=1)
    return replace(inputs, counts=True, scores=True)


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
    seen = 0
    for seed in range(3):
        inputs, thresholds = scene(seed, near), torch.full((14,), threshold)
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
    inputs = scene(0, near=False)
    inputs.splats.opacities.zero_()
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
