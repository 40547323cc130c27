"""Which rows of a model a selection of them has, proved bit by bit."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
import torch
from torch import Tensor

from fragprune_plugins.adapting import AlignmentError, copies

COLUMNS = {
    "means": ("x", "y", "z"),
    "opacities": ("opacity",),
    "scales": ("scale_0", "scale_1", "scale_2"),
    "quats": ("rot_0", "rot_1", "rot_2", "rot_3"),
}
"""What the exporter calls the columns of each parameter."""


def rows_exported(params: Mapping[str, Tensor], columns: Mapping[str, Any]) -> Tensor:
    """(M,) int64 rows of the model that are in an exported file, in its order.

    The exporter leaves out rows outside its box, rows with NaN and rows of low opacity.

    Args:
        params: the model's parameters, (N, C) each.
        columns: of the file by name, (M,) or (M, 1) each.

    Raises:
        AlignmentError: the file's rows are not the model's in their order.
    """
    if absent := [each for names in COLUMNS.values() for each in names if each not in columns]:
        where = "ns-export gaussian-splat"
        expected = "the model's positions, opacities, scales and rotations"
        remedy = "Report this with nerfstudio's version: it exports in another way."
        raise AlignmentError(where, f"a file without {', '.join(absent)}", expected, remedy)
    files = {
        name: torch.from_numpy(
            np.stack([np.asarray(columns[each]).reshape(-1) for each in names], axis=1)
        )
        for name, names in COLUMNS.items()
    }
    return rows_among({name: params[name].detach() for name in COLUMNS}, files, "ns-export")


def rows_among(known: Mapping[str, Tensor], chosen: Mapping[str, Tensor], where: str) -> Tensor:
    """(M,) int64 rows of ``known`` (N, C) that are in ``chosen`` (M, C), in the same order.

    Rows that are equal in every value are selected together. AlignmentError if it is no selection.
    """
    tables = [[each[name].cpu() for name in known] for each in (known, chosen)]
    ours, theirs = (copies(tables[0], each) for each in tables)
    rows = torch.isin(ours, theirs).nonzero()[:, 0]
    if not torch.equal(ours[rows], theirs):
        found = f"{len(theirs)} Gaussians, of which {len(rows)} are the model's in its order"
        expected = f"a selection of the model's {len(ours)} Gaussians"
        remedy = "Report this with nerfstudio's version: it selects in another way."
        raise AlignmentError(where, found, expected, remedy)
    return rows
