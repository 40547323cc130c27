"""A stand-in for pointops2_cuda: the nearest neighbours for the host's rigidity loss."""

from __future__ import annotations

import torch
from torch import Tensor


def knnquery(
    count: int,
    nearest: int,
    points: Tensor,
    queries: Tensor,
    offsets: Tensor,
    query_offsets: Tensor,
    indices: Tensor,
    distances: Tensor,
) -> None:
    """Nearest points of each query among the points of its batch, nearest first.

    Args:
        count: M, number of queries.
        nearest: k, how many.
        points: (N, 3).
        queries: (M, 3).
        offsets: (B,) where each batch of points ends.
        query_offsets: (B,) where each batch of queries ends.
        indices: (M, k) int32, filled with rows of ``points``.
        distances: (M, k) filled with squared distances.
    """
    from scipy.spatial import cKDTree

    first = first_query = 0
    for last, last_query in zip(offsets.tolist(), query_offsets.tolist(), strict=True):
        cloud = points[first:last].detach().cpu().double().numpy()
        asked = queries[first_query:last_query].detach().cpu().double().numpy()
        found, rows = cKDTree(cloud).query(asked, k=range(1, nearest + 1))
        batch = slice(first_query, last_query)
        indices[batch] = torch.from_numpy(rows + first).to(indices)
        distances[batch] = torch.from_numpy(found).square().to(distances)
        first, first_query = last, last_query
