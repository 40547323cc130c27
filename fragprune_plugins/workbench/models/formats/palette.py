"""Codebooks and palettes: few values that stand for many."""

from __future__ import annotations

from typing import Any

import numpy as np
import numpy.typing as npt

Floats = npt.NDArray[np.float32]
_BINS = 256  # wide enough that the tails, whose levels matter, are not noise
_ROUNDS = 20
_EVEN = 1e-9  # squared error of a cell that need not be cut: rounding


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


def palette(
    rows: Floats, size: int = 1 << 16
) -> tuple[npt.NDArray[np.float32], npt.NDArray[np.int64]]:
    """A palette of at most ``size`` rows for (N, D) rows, and (N,) the entry of each.

    An entry is the mean of its cell. Cells with a large squared error are cut at the mean of the
    coordinate that varies most in them, half of all cells at a time, until there are enough.
    """
    count = len(rows)
    cells = np.zeros(count, np.int64)
    if count <= size:
        return rows, np.arange(count)
    error, axis, place = np.zeros(size), np.zeros(size, np.int64), np.zeros(size)
    used, inside = 1, np.arange(count)  # the rows of cells that are new
    while True:
        names, held, means = _means(rows[inside], cells[inside])
        squares = _means(rows[inside].astype(np.float64) ** 2, cells[inside])[2]
        spread = held[:, None] * (squares - means**2)
        axis[names] = spread.argmax(axis=1)
        place[names] = means[np.arange(len(names)), axis[names]]
        error[names] = np.where(held > 1, spread.sum(axis=1), 0)
        uneven = np.flatnonzero(error[:used] > _EVEN)
        cut = min(size - used, -(-len(uneven) // 2))
        if cut == 0:
            break
        chosen = uneven[np.argpartition(-error[uneven], cut - 1)[:cut]]
        upper = np.full(size, -1)
        upper[chosen] = used + np.arange(cut)
        used += cut
        inside = np.flatnonzero(upper[cells] >= 0)
        of = cells[inside]
        above = rows[inside, axis[of]] > place[of]
        cells[inside[above]] = upper[of[above]]
    cells = np.unique(cells, return_inverse=True)[1]
    return _means(rows, cells)[2].astype(np.float32), cells


def _means(
    rows: npt.NDArray[Any], cells: npt.NDArray[np.int64]
) -> tuple[npt.NDArray[np.int64], npt.NDArray[np.int64], npt.NDArray[np.float64]]:
    """The names of cells, the number of their rows, and the means of these."""
    order = np.argsort(cells, kind="stable")
    names, starts, held = np.unique(cells[order], return_index=True, return_counts=True)
    sums = np.add.reduceat(rows[order].astype(np.float64), starts, axis=0)
    return names, held, sums / held[:, None]
