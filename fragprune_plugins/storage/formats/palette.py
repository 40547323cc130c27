"""Codebooks and palettes: few values that stand for many."""

from __future__ import annotations

from typing import Any

import numpy as np
import numpy.typing as npt

Floats = npt.NDArray[np.float32]

_BINS = 4096
_ROUNDS = 20
_DEPTH = 16  # a palette has at most 2^16 entries


def codebook(values: npt.NDArray[Any], size: int = 256) -> Floats:
    """(size,) ascending values with a small mean squared distance to values of any shape.

    Values that are few enough stay as they are. Else it is Lloyd's algorithm in one dimension, from
    the spacing that is best for many levels: the cube root of the density (Panter and Dite).
    """
    few = np.unique(values)
    if len(few) <= size:
        return np.pad(few, (0, size - len(few)), mode="edge").astype(np.float32)
    ordered = np.sort(values.astype(np.float64), axis=None)
    counts, edges = np.histogram(ordered, _BINS)
    share = np.concatenate([[0], np.cumsum(np.cbrt(counts))])
    levels = np.interp((np.arange(size) + 0.5) / size * share[-1], share, edges)
    sums = np.concatenate([[0], np.cumsum(ordered)])
    for _ in range(_ROUNDS):
        ends = np.searchsorted(ordered, (levels[1:] + levels[:-1]) / 2)
        ends = np.concatenate([[0], ends, [len(ordered)]])
        held = np.diff(ends)
        levels = np.where(held > 0, np.diff(sums[ends]) / np.maximum(held, 1), levels)
        levels.sort()
    book: Floats = levels.astype(np.float32)
    return book


def nearest(book: Floats, values: npt.NDArray[Any]) -> npt.NDArray[np.uint8]:
    """The index of the nearest value in an ascending codebook, for values of any shape."""
    return np.searchsorted((book[1:] + book[:-1]) / 2, values).astype(np.uint8)


def median_cut(rows: Floats) -> tuple[Floats, npt.NDArray[np.int64]]:
    """A palette of at most 65,536 rows for (N, D) rows, and (N,) the entry of each.

    Cells are halved, sixteen times, at the median of the coordinate that varies most in them; an
    entry is its cell's mean. Rows that are few enough have an entry each.
    """
    count = len(rows)
    cells = np.zeros(count, np.int64)
    if count <= 1 << _DEPTH:
        return rows, np.arange(count)
    for _ in range(_DEPTH):
        means, held = _means(rows, cells)
        spread = _means(rows**2, cells)[0] - means**2
        value = rows[np.arange(count), spread.argmax(axis=1)[cells]]
        order = np.lexsort((value, cells))
        starts = np.concatenate([[0], np.cumsum(held)[:-1]])
        rank = np.arange(count) - starts[cells[order]]
        upper = np.empty(count, np.int64)
        upper[order] = rank >= (held[cells[order]] + 1) // 2
        cells = np.unique(2 * cells + upper, return_inverse=True)[1]
    return _means(rows, cells)[0].astype(np.float32), cells


def _means(
    rows: npt.NDArray[Any], cells: npt.NDArray[np.int64]
) -> tuple[npt.NDArray[Any], npt.NDArray[np.int64]]:
    """The mean of the rows of each cell, and their number."""
    held = np.bincount(cells)
    starts = np.concatenate([[0], np.cumsum(held)[:-1]])
    sums = np.add.reduceat(rows[np.argsort(cells, kind="stable")], starts, axis=0)
    return sums / held[:, None], held
