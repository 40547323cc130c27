"""A model's tables hold what the model holds; in few bytes, what a .spz file makes of it."""

import json
import math
import zlib

import numpy as np
import pytest
import torch
from finetune import tiny

from fragprune_plugins import Model, overview
from fragprune_plugins.workbench.models import formats
from fragprune_plugins.workbench.models.formats.arrays import morton_order
from fragprune_plugins.workbench.view.packing import compact, pack
from fragprune_plugins.workbench.view.site import Layer, compacted, make_site

KIND = [
    *(("mean", "<f4", 3), ("opacity", "<u2"), ("cutoff", "<u2"), ("turn", "<i2", 4)),
    *(("scale", "<u2", 3), ("spare", "<u2")),
]


def read(data, facts):
    """The tables, read in another way: by field of a record."""
    table = np.frombuffer(data, np.dtype(KIND), facts["gaussians"])
    harmonics = np.frombuffer(data, "<f2", offset=table.nbytes).reshape(len(table), -1)
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


@pytest.mark.parametrize("cut", [False, True])
def test_without_thresholds_above_one_in_255_every_cutoff_is_the_last(cut):
    splat = tiny.random_model()
    data, facts = pack(tiny.cut(splat, 1e-3) if cut else splat)
    assert facts["truncated"] is cut
    assert (read(data, facts)[0]["cutoff"] == 65535).all()


def test_scales_that_are_all_equal():
    splat = tiny.random_model()
    splat.scaling.fill_(-2.0)
    data, facts = pack(splat)
    low, high = facts["scales"]
    assert high > low
    scales = np.exp(low + read(data, facts)[0]["scale"] / 65535 * (high - low))
    np.testing.assert_allclose(scales, math.exp(-2), rtol=1e-4)


def a_model(degree: int = 1, count: int = 400) -> Model:
    return tiny.cut(tiny.random_model(count, degree, 5), torch.linspace(0.002, 0.9, count))


def of_spz(folder, model: Model) -> Model:
    """What a .spz file keeps of a model."""
    path = folder / "model.spz"
    formats.write(formats.named(path), path, model)
    return formats.read(path)


def expand(data: bytes, facts: dict) -> tuple[np.ndarray, np.ndarray]:
    """Geometry (N, 16) and harmonics (N, K) as 16-bit words, row by row from the description."""
    stream, count, rows = memoryview(zlib.decompress(data)), facts["gaussians"], facts["rows"]

    def planes(number, length=count):
        nonlocal stream
        held, stream = stream[: number * length], stream[number * length :]
        return np.frombuffer(held, np.uint8).reshape(number, length).astype(np.int64)

    def words(columns, length=count):
        book = np.frombuffer(planes(1, 512).astype(np.uint8).tobytes(), "<u2")
        return book[planes(columns, length)].T

    def numbers():
        return np.array([1, 1 << 8, 1 << 16, 1 << 24]) @ planes(4)

    steps = [[n // 2 if n % 2 == 0 else -(n // 2) - 1 for n in numbers()] for _ in range(3)]
    means = (np.cumsum(steps, axis=1) / 2 ** facts["bits"]).T.astype("<f4")
    turns = np.empty((count, 4))
    for row, (*lower, upper) in enumerate(planes(4).T):
        three = [
            (-1 if upper >> 2 * k & 1 else 1)
            * (low + 256 * (upper >> 2 * k + 1 & 1))
            / 511
            / 2**0.5
            for k, low in enumerate(lower)
        ]
        turns[row] = np.insert(three, upper >> 6, max(0, 1 - np.square(three).sum()) ** 0.5)
    opacities, cutoffs, scales, colours = (words(columns) for columns in (1, 1, 3, 3))
    rest = 3 * (facts["degree"] + 1) ** 2 - 3
    book = np.frombuffer(planes(1, 512).astype(np.uint8).tobytes(), "<u2")
    which = numbers() if rows < count else np.arange(count)
    harmonics = book[planes(rest, rows)].T.reshape(rows, rest)[which]
    assert not len(stream)
    turned = np.rint(turns * 32767).astype("<i2").view("<u2")
    places = np.ascontiguousarray(means).view("<u2")
    geometry = np.hstack([places, opacities, cutoffs, turned, scales, 0 * opacities])
    return geometry, np.hstack([colours, harmonics])


def tables(model: Model) -> tuple[np.ndarray, np.ndarray]:
    """The same of what ``pack`` gives, in the order of ``compact``."""
    (data, facts), order = pack(model), morton_order(model)
    count = len(model)
    geometry = np.frombuffer(data, "<u2", count * 16).reshape(count, 16)
    harmonics = np.frombuffer(data, "<u2", offset=count * 32).reshape(count, -1)
    return geometry[order], harmonics[order, : 3 * (facts["degree"] + 1) ** 2]


@pytest.mark.parametrize("degree", range(4))
def test_a_model_of_an_spz_file_stays_what_it_is(degree, tmp_path):
    model = of_spz(tmp_path, a_model(degree))
    data, facts = pack(model)
    small, more, rounded = compact(data, facts)
    assert rounded == []
    geometry, harmonics = expand(small, facts | more)
    expected, coefficients = tables(model)
    np.testing.assert_array_equal(harmonics, coefficients)
    turns, wanted = (each[:, 8:12].copy().view("<i2").astype(int) for each in (geometry, expected))
    signs = np.sign((turns * wanted).sum(axis=1, keepdims=True))
    assert np.abs(turns - signs * wanted).max() <= 1
    others = np.delete(np.arange(16), np.arange(8, 12))
    np.testing.assert_allclose(geometry[:, others], expected[:, others], rtol=0, atol=1)


def test_another_model_becomes_what_an_spz_file_keeps_and_says_so(tmp_path):
    model = a_model(2)
    data, facts = pack(model)
    small, more, rounded = compact(data, facts)
    assert " ".join(rounded) == "positions rotations opacities cutoffs scales colours harmonics"
    assert len(small) < len(data) / 3
    geometry, harmonics = expand(small, facts | more)
    expected, coefficients = tables(of_spz(tmp_path, model))
    np.testing.assert_allclose(geometry[:, :8], expected[:, :8], rtol=0, atol=1)
    assert (harmonics != coefficients).mean() < 1e-3  # half floats in the middle of a step
    low, high = facts["scales"]
    scales = low + geometry[:, 12:15] / 65535 * (high - low)
    given = model.scaling[morton_order(model)].numpy()
    assert np.abs(scales - given).max() <= 1 / 32 + 1e-3


def test_rows_of_harmonics_that_repeat_are_there_once():
    model = a_model(3)
    model.f_rest[:] = model.f_rest[torch.arange(len(model)) % 7]
    data, facts = pack(model)
    small, more, _ = compact(data, facts)
    assert more["rows"] == 7
    each = model.f_rest[morton_order(model)].flatten(1).numpy()
    off = np.abs(expand(small, facts | more)[1][:, 3:].view("<f2") - each)
    assert off.max() <= 1 / 16 + 1 / 256


def test_a_small_unit_does_not_make_a_scene_coarse():
    model = a_model()
    model.xyz.mul_(1e-3)
    data, facts = pack(model)
    small, more, _ = compact(data, facts)
    means = expand(small, facts | more)[0][:, :6].copy().view("<f4")
    off = np.abs(means - model.xyz[morton_order(model)].numpy()).max()
    assert off < model.xyz.abs().max() / 1000


def test_a_scale_of_nearly_nothing_does_not_make_the_others_coarse():
    """As of a Gaussian that an editor has flattened."""
    model = a_model()
    for least in (-80, -9):  # all other logarithms are then of 300 steps
        model.scaling[5] = least
        data, facts = pack(model)
        small, more, _ = compact(data, facts)
        low, high = facts["scales"]
        scales = low + expand(small, facts | more)[0][:, 12:15] / 65535 * (high - low)
        off = np.abs(scales - model.scaling[morton_order(model)].numpy())
        assert np.quantile(off, 0.9) <= 1 / 32 + 1e-3
        model.scaling[6:] = torch.linspace(-9, 9, 3 * (len(model) - 6)).reshape(-1, 3)


def test_a_model_with_a_mean_that_no_step_reaches_keeps_its_tables():
    far, near = a_model(), a_model()
    far.xyz[3, 1] = 1e9
    layers = [Layer("far", 0, True), Layer("near", 1, True)]
    site = make_site("two", [far, near], layers, (), overview(near))
    small, _ = compacted(site)
    kept = [small[name] == site[name] for name in ("model-0.splats", "model-1.splats")]
    assert kept == [True, False]
    assert ["bits" in facts for facts in json.loads(small["scene.json"])["models"]] == [False, True]
