"""Images: by hand, and against loops over Python floats."""

from dataclasses import replace

import pytest
import scenes
import torch
from oracle import naive

from fragprune_plugins.engines.reference import ReferenceEngine, camera_of, gaussians_of
from reference_renderer import Options, render

F64 = torch.float64


def draw(inputs, thresholds=None):
    return ReferenceEngine().rasterize(replace(inputs, counts=True, scores=True), thresholds)


CASES = {
    "plain": {},
    "sh degree 0": {"sh_degree": 0},
    "sh degree 3": {"sh_degree": 3},
    "colours": {"colors": True},
    "covariances": {"cov3d": True},
    "antialiased": {"compensation": "antialiasing"},
    "mip": {"compensation": "mip"},
    "offsets, features": {"offsets": True, "features": 2},
    "scaled": {"scale_modifier": 1.7},
    "scaled, covariances": {"scale_modifier": 1.7, "cov3d": True},
    "stopped": {"stop": 0.3},
}


@pytest.mark.parametrize("truncated", [False, True], ids=["whole", "truncated"])
@pytest.mark.parametrize("name", CASES)
def test_every_output_equals_that_of_loops_over_floats(name, truncated):
    scene = scenes.random_scene(3, 40, 34, 20, dtype=F64, **CASES[name])
    tau = scenes.random_thresholds(4, 40, dtype=F64) if truncated else None
    drawn = draw(scene, tau)
    splats = naive.splats_of(scene, tau)
    per_row, wins, weights = [0] * 40, [0] * 40, [0.0] * 40
    for y in range(20):
        for x in range(34):
            offset = (0, 0) if scene.sample_offsets is None else scene.sample_offsets[y, x].tolist()
            records, light = naive.records_at(splats, x, y, offset, scene.stop)
            winner, most = -1, 0.0
            for record in records:
                per_row[record.row] += record.drawn
                weight = record.alpha * record.light if record.drawn else 0
                weights[record.row] += weight
                if weight > most:
                    winner, most = record.row, weight
            if winner >= 0:
                wins[winner] += 1
            assert drawn.winners[y, x].item() == winner
            if scene.splats.features is not None:
                columns = scene.splats.features.T.tolist()
                sums = [naive.sum_at(records, lambda r, f=f: f[r.row]) for f in columns]
                assert drawn.features[:, y, x].tolist() == pytest.approx(sums, abs=1e-12)
            sums = [naive.sum_at(records, lambda r, c=c: r.color[c]) for c in range(3)]
            background = scene.view.background.tolist()
            expected = [s + light * b for s, b in zip(sums, background, strict=True)]
            assert drawn.image[:, y, x].tolist() == pytest.approx(expected, rel=1e-9, abs=1e-12)
            assert drawn.alpha[0, y, x].item() == pytest.approx(1 - light, abs=1e-12)
            invdepth = naive.sum_at(records, lambda r: 1 / r.depth)
            assert drawn.invdepth[0, y, x].item() == pytest.approx(invdepth, abs=1e-12)
            assert drawn.fragments[y, x].item() == sum(r.drawn for r in records)
    assert drawn.fragments_per_gaussian.tolist() == per_row
    assert drawn.wins_per_gaussian.tolist() == wins
    assert drawn.weights_per_gaussian.tolist() == pytest.approx(weights, rel=1e-6)
    assert drawn.fragments_per_pixel.item() == pytest.approx(sum(per_row) / (34 * 20))
    radii = {s.row: s.radius for s in splats}
    assert drawn.radii.tolist() == [radii.get(i, 0) for i in range(40)]


def test_evaluated_counts_every_splat_at_every_pixel_of_its_tiles():
    scene = scenes.random_scene(5, 30, 34, 20, dtype=F64)
    pairs = 0
    for s in naive.splats_of(scene):
        columns = min(34, 16 * s.rect[2]) - 16 * s.rect[0]
        rows = min(20, 16 * s.rect[3]) - 16 * s.rect[1]
        pairs += columns * rows
    assert draw(scene).evaluated_per_pixel * 34 * 20 == pytest.approx(pairs)


def test_single_precision_differs_only_by_rounding_and_the_odd_flip():
    tau = scenes.random_thresholds(1, 200)
    single = draw(scenes.random_scene(6, 200, 48, 40), tau).image.double()
    double = draw(scenes.random_scene(6, 200, 48, 40, dtype=F64), tau.double()).image
    off = (single - double).abs().amax(0)
    assert (off > 2e-5).sum() <= 4
    assert off.max() < 0.05


def test_without_tiles_and_cuts_the_image_is_the_plain_sum_over_all_splats():
    scene = scenes.stack([0.5, 0.4, 0.3], dtype=F64)
    options = Options(alpha_min=0, transmittance_min=0, tiles=False)
    drawn = render(camera_of(scene), gaussians_of(scene.splats), options=options)
    assert drawn.fragments.tolist() == [[3] * 17] * 17
    assert drawn.alpha[0, 8, 8].item() == pytest.approx(1 - 0.5 * 0.6 * 0.7)
