"""A model's tables hold what the model holds, to the stated precision."""

import math

import numpy as np
import pytest
import torch
from finetune import tiny

from fragprune_plugins.workbench.view.packing import pack


def read(data, facts):
    """The tables, read in another way: by field of a record."""
    count = facts["gaussians"]
    kind = np.dtype(
        [
            ("mean", "<f4", 3),
            ("opacity", "<u2"),
            ("cutoff", "<u2"),
            ("turn", "<i2", 4),
            ("scale", "<u2", 3),
            ("spare", "<u2"),
        ]
    )
    table = np.frombuffer(data, kind, count)
    harmonics = np.frombuffer(data, "<f2", offset=table.nbytes).reshape(count, -1)
    return table, harmonics


@pytest.mark.parametrize("degree", range(4))
def test_tables_hold_the_model(degree):
    splat = tiny.random_model(degree=degree)
    thresholds = torch.linspace(0.005, 0.9, len(splat))
    data, facts = pack(tiny.cut(splat, thresholds))
    texels = -(-3 * (degree + 1) ** 2 // 8)  # of eight half floats
    assert len(data) == (32 + 16 * texels) * len(splat)
    assert facts["degree"] == degree
    assert facts["truncated"] is True
    table, harmonics = read(data, facts)
    drawn = splat.splats()
    low, high = facts["scales"]
    np.testing.assert_array_equal(table["mean"], splat.xyz)
    np.testing.assert_allclose(table["opacity"] / 65535, drawn.opacities, atol=1e-5)
    cutoffs = table["cutoff"] / 65535 * 2 * math.log(255)
    np.testing.assert_allclose(cutoffs, -2 * thresholds.log(), atol=1e-4)
    np.testing.assert_allclose(table["turn"] / 32767, drawn.rotations, atol=2e-5)
    scales = np.exp(low + table["scale"] / 65535 * (high - low))
    np.testing.assert_allclose(scales, drawn.scales, rtol=2e-4)
    colours = drawn.sh.flatten(1)
    np.testing.assert_allclose(harmonics[:, : colours.shape[1]], colours, rtol=1e-3, atol=1e-4)
    assert not harmonics[:, colours.shape[1] :].any()


def test_without_thresholds_every_cutoff_is_the_last():
    data, facts = pack(tiny.random_model())
    assert facts["truncated"] is False
    assert (read(data, facts)[0]["cutoff"] == 65535).all()


def test_a_threshold_below_one_in_255_decides_nothing():
    assert (read(*pack(tiny.cut(tiny.random_model(), 1e-3)))[0]["cutoff"] == 65535).all()


def test_scales_that_are_all_equal():
    splat = tiny.random_model()
    splat.scaling.fill_(-2.0)
    data, facts = pack(splat)
    low, high = facts["scales"]
    assert high > low
    np.testing.assert_allclose(
        np.exp(low + read(data, facts)[0]["scale"] / 65535 * (high - low)), math.exp(-2), rtol=1e-4
    )
