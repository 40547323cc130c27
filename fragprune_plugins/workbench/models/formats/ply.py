"""Writes the PLY that ``files.ply`` reads."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import torch
from plyfile import PlyData, PlyElement
from torch import Tensor

from fragprune_plugins.files import ply
from fragprune_plugins.files.atomic import replacing
from fragprune_plugins.files.model import Model


def write_ply(path: Path, model: Model) -> None:
    """Write a model in the hosts' layout, whole or not at all, with the exact values that it has.

    Thresholds that cut become the last column, ``trunc_threshold``, a stop and a soft rim comments.
    OutputError if it cannot be written.
    """
    n = len(model)
    rest = model.f_rest.transpose(1, 2).reshape(n, -1)
    columns: list[tuple[tuple[str, ...], Tensor]] = [
        (ply.XYZ, model.xyz),
        (("nx", "ny", "nz"), torch.zeros(n, 3)),
        (ply.DC, model.f_dc[:, 0]),
        (tuple(f"f_rest_{i}" for i in range(rest.shape[1])), rest),
        (("opacity",), model.opacity),
        (ply.SCALES[: model.scaling.shape[1]], model.scaling),
        (ply.ROTATION, model.rotation),
    ]
    if model.filter_3d is not None:
        columns.append(((ply.FILTER,), model.filter_3d))
    if (falloff := model.falloff) is not None:
        columns.append(((ply.THRESHOLD_COLUMN,), falloff.reshape(n, 1)))
    names = [name for group, _ in columns for name in group]
    table = torch.cat([values.detach().cpu().float() for _, values in columns], dim=1)
    rows = np.ascontiguousarray(table.numpy()).view([(name, "<f4") for name in names])[:, 0]
    # An element's comments come after its line: some viewers read the number of Gaussians off the
    # header's third line, whatever it says.
    comments = [] if model.stop is None else [f"{ply.STOP} {model.stop!r}"]
    if model.rim != "hard":
        comments.append(f"{ply.RIM} {model.rim}")
    vertices = PlyElement.describe(rows, "vertex", comments=comments)
    with replacing(path) as temporary:
        PlyData([vertices], byte_order="<").write(str(temporary))
