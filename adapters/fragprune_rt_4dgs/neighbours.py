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
    """Nearest ``points`` (N, 3) of each of ``count`` ``queries`` (M, 3) in its own batch.

    ``offsets`` (B,) say where batches end. Rows of points go to ``indices`` (M, nearest) int32,
    squared distances to ``distances`` (M, nearest).
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
