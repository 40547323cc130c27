"""Scores equal what loops over floats give, fragment by fragment."""

from __future__ import annotations

import pytest
import torch
from lab import scores
from measure.test_scores import COUNT, VIEWS, colour, pixels, scene

from fragprune_plugins.engines import create_engine


@pytest.fixture(scope="module", params=[False, True], ids=["whole", "truncated"])
def expected(request):
    """Every score by brute force, and the scene."""
    model = scene(request.param)
    splats = model.splats()
    keys = ("total-weight", "largest-weight", "falloff-gradient", "hits")
    found = {key: [0.0] * COUNT for key in keys}
    mean = [[[0.0, 0, 0] for _ in VIEWS] for _ in range(COUNT)]  # weight, fragments, wins
    opacities, size = splats.opacities.double().tolist(), VIEWS[0].width * VIEWS[0].height
    for pixel, (records, background) in enumerate(pixels(model)):
        number = pixel // size
        pairs = [(r.alpha, r.color) for r in records]
        whole = colour(pairs, background)
        weights = [r.alpha * r.light for r in records]
        for k, (record, weight) in enumerate(zip(records, weights, strict=True)):
            row = record.row
            found["total-weight"][row] += weight
            found["largest-weight"][row] = max(found["largest-weight"][row], weight)
            found["hits"][row] += 1
            step = 1e-4  # a pixel is linear in one falloff: any step is exact
            moved = record.alpha + step * opacities[row], record.color
            more = [*pairs[:k], moved, *pairs[k + 1 :]]
            slope = (sum(colour(more, background)) - sum(whole)) / step
            found["falloff-gradient"][row] += slope**2
            mean[row][number][0] += weight
            mean[row][number][1] += 1
        if weights:
            mean[records[weights.index(max(weights))].row][number][2] += 1
    found["mini-splatting"] = [
        sum(weight / hits for weight, hits, wins in views if wins) for views in mean
    ]
    volumes = splats.scales.double().prod(dim=1)
    hits = torch.tensor(found["hits"], dtype=torch.float64)
    found["light-gaussian"] = (splats.opacities.double() * hits * volumes**0.1).tolist()
    found["opacity"] = opacities
    return model, found


EXACT = sorted(set(scores.SCORES) - {"removal-error"})


@pytest.mark.parametrize("name", EXACT)
def test_a_score_equals_that_of_loops_over_floats(expected, name):
    model, found = expected
    got = scores.SCORES[name](model, VIEWS, create_engine("auto"))
    assert got.shape == (COUNT,)
    assert got.tolist() == pytest.approx(found[name], rel=1e-3, abs=1e-6)
