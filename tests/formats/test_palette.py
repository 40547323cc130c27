"""Codebooks and palettes against exhaustive choices and their own promises."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.cluster.vq import kmeans2

from fragprune_plugins.workbench.models.formats.palette import codebook, nearest, palette

seeds = st.integers(0, 1 << 31)


def test_few_values_are_their_own_codebook():
    values = np.random.default_rng(0).choice([-3.0, 0.25, 7.5], (40, 3)).astype(np.float32)
    book = codebook(values)
    assert len(book) == 256
    assert np.array_equal(book[nearest(book, values)], values)


@pytest.mark.parametrize("kind", ["normal", "uniform", "laplace"])
def test_a_codebook_beats_even_steps_and_quantiles(kind):
    values = getattr(np.random.default_rng(1), kind)(size=20_000).astype(np.float32)
    even = np.linspace(values.min(), values.max(), 256, dtype=np.float32)
    quantiles = np.quantile(values, (np.arange(256) + 0.5) / 256).astype(np.float32)
    errors = [
        np.square(book[nearest(book, values)] - values).mean()
        for book in (codebook(values), even, quantiles)
    ]
    assert errors[0] <= 1.02 * min(errors)


@given(seeds)
def test_the_nearest_value_is_the_nearest(seed):
    stream = np.random.default_rng(seed)
    book, values = np.sort(stream.normal(size=256)), stream.normal(size=50)
    expected = np.abs(book - book[nearest(book, values)][:, None]).min(axis=1)
    assert (expected == 0).all()
    distances = np.abs(values[:, None] - book)
    assert np.abs(values - book[nearest(book, values)]) == pytest.approx(distances.min(axis=1))


@given(seeds, st.integers(1, 60), st.integers(1, 90))
def test_a_palette_is_made_of_means(seed, size, count):
    rows = np.random.default_rng(seed).normal(size=(count, 4)).astype(np.float32)
    entries, labels = palette(rows, size)
    assert len(entries) <= size
    assert sorted(set(labels)) == list(range(len(entries)))
    for index, entry in enumerate(entries):
        assert entry == pytest.approx(rows[labels == index].mean(axis=0), abs=1e-5)


def test_rows_that_are_few_but_repeated_are_exact():
    stream = np.random.default_rng(2)
    few = stream.normal(size=(50, 9)).astype(np.float32)
    rows = few[stream.integers(0, 50, 5000)]
    entries, labels = palette(rows, 64)
    assert np.abs(entries[labels] - rows).max() < 1e-5


def test_a_palette_has_less_than_twice_the_error_of_k_means():
    rows = np.random.default_rng(3).laplace(size=(3000, 3)).astype(np.float32)
    entries, labels = palette(rows, 128)
    centres, of = kmeans2(rows, 128, seed=0, minit="++")
    ours, best = (np.square(e[k] - rows).mean() for e, k in ((entries, labels), (centres, of)))
    assert ours < 2 * best
