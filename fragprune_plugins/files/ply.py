"""Trained splats on disk: the PLY layout that all descendants of 3DGS share.

Values before activation: x y z, nx ny nz (zeros), f_dc_0..2, f_rest_0.. (channel-major: all of red,
then green, then blue), opacity (logit), scale_0..2 (log), rot_0..3 (w x y z, any length). Other
columns are ignored, and named in the log, unless they change the picture (``columns``).
"""

from __future__ import annotations

import math
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor

from fragprune_plugins.errors import ModelFileError, log
from fragprune_plugins.files.columns import change_of, is_plain
from fragprune_plugins.files.model import REST_COUNTS, Model
from fragprune_plugins.files.ply_table import HEADER_MAX, Columns, header_lines, read_vertices
from fragprune_plugins.files.reading import Reading, UntrustedFile
from fragprune_plugins.learning.thresholds import ThresholdStore

THRESHOLD_COLUMN = "trunc_threshold"  # in falloff, in (0, 1); 0 is read as neutral
STOP = "fragprune stop"  # begins the comment that holds a model's stop
RIM = "fragprune rim"  # begins the comment that says how a model's thresholds cut, if not hard

XYZ = ("x", "y", "z")
DC = ("f_dc_0", "f_dc_1", "f_dc_2")
SCALES = ("scale_0", "scale_1", "scale_2")
ROTATION = ("rot_0", "rot_1", "rot_2", "rot_3")
FILTER = "filter_3D"
_REMEDY = "Pass the point_cloud.ply that a 3DGS training saved."
_FILE = UntrustedFile(
    ModelFileError,
    "not readable as PLY",
    "a complete trained splat (.ply)",
    "The file is of another kind or was cut off: copy or save it again.",
    missing=_REMEDY,
)

LOG_SCALE_MAX = 30.0
"""Largest logarithm of a standard deviation: 1e13 world units. Projection multiplies it by the
focal length and squares it, and float32 ends at 1e38."""

_QUATERNION_MIN = 1e-12  # torch's normalize divides by no less

_warn = cache(log.warning)  # once, because commands read a file several times

_SHOWN_COLUMNS = 12
_BLOCK = 4096  # rows that are read column by column, so that they stay in the cache
_ENDLESS = 80.0  # in place of infinite logits and logarithms: exp(-80) is nothing, squared 0
_SHOWN_ROWS = 5  # of those that a message is about


def read_ply(path: Path, *, filtered: bool = False) -> Model:
    """Read a trained splat. The number of f_rest columns gives the SH degree.

    Args:
        filtered: accept a model that the caller draws by its host's rules: one with a 3D filter
            (Mip-Splatting), or of surfels, which have two scales (2D Gaussian Splatting).

    Raises:
        ModelFileError: missing, truncated, not a PLY, not a Gaussian splat, empty or not finite.
    """
    path = Path(path)
    if path.suffix in (".pth", ".pt", ".ckpt"):
        found = "a training codebase's checkpoint, which only that codebase can draw"
        remedy = "Pass its PLY. Fine-tune and draw a host without PLYs (4D models) through its own "
        remedy += "script, with fragprune run."
        raise ModelFileError(str(path), found, "a trained splat (.ply)", remedy)
    with _FILE.reading(path) as reading:
        rules = _rules_in(reading)
        try:
            columns = read_vertices(reading)
        except KeyError as error:
            found = "a PLY without a vertex element"
            raise ModelFileError(str(path), found, "a Gaussian splat", _REMEDY) from error
        model = _splat(path, columns, filtered)
        return model.with_rules(**rules) if rules else model


def _rules_in(reading: Reading) -> dict[str, Any]:
    """The stop and the rim that a PLY's header names, by these names. The file is rewound."""
    rules: dict[str, Any] = {}
    for line in header_lines(reading.file.read(HEADER_MAX))[0]:
        for name, words in (("stop", STOP), ("rim", RIM)):
            if line.startswith(begin := f"comment {words} ".encode()) and name not in rules:
                rules[name] = line.removeprefix(begin).strip().decode()
    reading.file.seek(0)
    return rules | ({"stop": float(rules["stop"])} if "stop" in rules else {})


def _splat(path: Path, columns: Columns, filtered: bool) -> Model:
    """The splat of a file's columns; raises ModelFileError."""
    names, count = columns.keys(), len(next(iter(columns.values())))
    scales = SCALES if SCALES[2] in names else SCALES[:2]
    missing = [name for name in (*XYZ, *DC, "opacity", *scales, *ROTATION) if name not in names]
    if missing == list(DC) and "red" not in names:
        found = (
            "activated Gaussians without colours, from a codebase that keeps colours in a network"
        )
        expected = "a splat with colours and values before activation"
        remedy = "Fine-tune with fragprune run inside that host."
        raise ModelFileError(str(path), found, expected, remedy)
    if missing:
        expected = "the columns of a Gaussian splat"
        remedy = "A point cloud or mesh is not a trained splat; ns-export writes one with "
        remedy += "--ply-color-mode sh_coeffs. " + _REMEDY
        raise ModelFileError(str(path), f"a PLY without {', '.join(missing)}", expected, remedy)
    if scales != SCALES and not filtered:
        found = (
            "flat Gaussians with two scales, as 2D Gaussian Splatting saves, and no 3D Gaussians"
        )
        remedy = "Fine-tune and draw it through its host's own scripts, with fragprune run."
        raise ModelFileError(str(path), found, "a splat of 3D Gaussians", remedy)
    if FILTER in names and not filtered:
        found = "a Mip-Splatting model, whose 3D filter (filter_3D) changes shapes and opacities"
        remedy = (
            "Fuse the filter first (create_fused_ply.py there), or fine-tune with fragprune run."
        )
        raise ModelFileError(str(path), found, "a splat that is drawn as it is stored", remedy)
    _expect_no_other(path, [name for name in names if not is_plain(name) and name != FILTER])
    rest = sorted(
        (name for name in names if name.startswith("f_rest_") and name[7:].isdecimal()),
        key=lambda name: (len(name), name),
    )
    if len(rest) not in REST_COUNTS or rest != [f"f_rest_{i}" for i in range(len(rest))]:
        expected = "0, 9, 24 or 45 (SH degree 0 to 3), numbered from 0"
        raise ModelFileError(str(path), f"{len(rest)} f_rest columns", expected, _REMEDY)
    if count == 0:
        raise ModelFileError(str(path), "0 Gaussians", "at least one", _REMEDY)

    def column(*wanted: str) -> Tensor:
        data = np.empty((count, len(wanted)), np.float32)
        with np.errstate(over="ignore"):  # a double beyond float32 becomes infinite, and is refused
            for first in range(0, count if wanted else 0, _BLOCK):
                rows = slice(first, first + _BLOCK)
                np.stack([columns[name][rows] for name in wanted], axis=1, out=data[rows])
        if wanted in (("opacity",), scales):  # of 0 and 1, which editors write
            np.nan_to_num(data, copy=False, nan=np.nan, posinf=_ENDLESS, neginf=-_ENDLESS)
        _require_finite(path, wanted, data)
        return torch.from_numpy(data)

    splat = Model(
        xyz=column(*XYZ),
        f_dc=column(*DC)[:, None, :],
        f_rest=column(*np.reshape(rest, (3, -1)).T.flat).reshape(count, len(rest) // 3, 3),
        opacity=column("opacity"),
        scaling=column(*scales),
        rotation=column(*ROTATION),
        thresholds=(
            _store_of(path, column(THRESHOLD_COLUMN)[:, 0]) if THRESHOLD_COLUMN in names else None
        ),
        filter_3d=column(FILTER) if FILTER in names else None,
    )
    expect_drawable(path, splat)
    return splat


def _expect_no_other(path: Path, others: list[str]) -> None:
    """Refuse columns that change the picture; name those that are ignored in the log."""
    for name in others:
        if says := change_of(name):
            found = f"a column {name}: {says}, which a plain drawing ignores"
            remedy = "Fine-tune and draw it through its host, or save it there as plain 3DGS."
            raise ModelFileError(str(path), found, "a splat that is drawn as it is stored", remedy)
    if others:
        shown = ", ".join(others[:_SHOWN_COLUMNS])
        more = f" and {len(others) - _SHOWN_COLUMNS} more" if len(others) > _SHOWN_COLUMNS else ""
        _warn(f"{path}: ignored its columns {shown}{more}")


def read_thresholds(path: Path) -> ThresholdStore | None:
    """The thresholds and the rules that a PLY itself holds; None if it has neither, or is no PLY.

    ModelFileError if it is truncated, or a threshold outside (0, 1).
    """
    with open(path, "rb") as file:
        try:
            lines = header_lines(file.read(HEADER_MAX))[0]
        except ValueError:
            return None
    column, comment = f" {THRESHOLD_COLUMN}".encode(), f"comment {STOP} ".encode()
    if not any(each.endswith(column) or each.startswith(comment) for each in lines):
        return None
    with _FILE.reading(path) as reading:
        rules, columns = _rules_in(reading), read_vertices(reading)
        values = columns.get(THRESHOLD_COLUMN, np.zeros(len(next(iter(columns.values())))))
        return _store_of(path, torch.from_numpy(values.astype(np.float32))).ruled(**rules)


def _require_finite(path: Path, names: tuple[str, ...], data: np.ndarray[Any, Any]) -> None:
    bad = ~np.isfinite(data)
    if bad.any():
        columns = bad.any(axis=0) if len(names) == bad.shape[1] else [True]
        where = ", ".join(n for n, b in zip(names, columns, strict=True) if b)
        found = f"NaN or infinity in {_rows(torch.from_numpy(bad.any(axis=1)), where)}"
        remedy = "Remove these rows, or use an earlier checkpoint if its training diverged."
        raise ModelFileError(str(path), found, "finite numbers", remedy)


def expect_drawable(path: Path, splat: Model) -> None:
    """Raise ModelFileError unless all is finite, and scales and rotations can be drawn."""
    for name in ("xyz", "f_dc", "f_rest", "opacity", "scaling", "rotation"):
        values = getattr(splat, name)
        _require_finite(path, (name,), values.reshape(len(splat), -1).numpy())
    vast = (splat.scaling > LOG_SCALE_MAX).any(dim=1)
    if splat.filter_3d is not None:
        vast |= splat.filter_3d[:, 0].abs() > math.exp(LOG_SCALE_MAX)
    length = splat.rotation.norm(dim=1)
    for wrong, found, expected in (
        (vast, "scales", f"logarithms of world units, at most {LOG_SCALE_MAX:g}"),
        (~(length >= _QUATERNION_MIN), "quaternions of length 0", "rotations w, x, y, z"),
        (length.isinf(), "quaternions too long to normalise", "rotations w, x, y, z"),
    ):
        if wrong.any():
            found = f"{found} that nothing can be drawn with in {_rows(wrong)}"
            remedy = "Remove these rows, or use an earlier checkpoint."
            raise ModelFileError(str(path), found, expected, remedy)


def _rows(wrong: Tensor, columns: str = "") -> str:
    """How many rows are wrong (N,) bool, in which columns, and the first of them, from 0."""
    rows, where = wrong.nonzero()[:, 0].tolist(), f" ({columns})" if columns else ""
    listed = ", ".join(map(str, rows[:_SHOWN_ROWS])) + ", ..." * (len(rows) > _SHOWN_ROWS)
    return f"{len(rows)} of {len(wrong)} rows{where}: {listed}"


def _store_of(path: Path, values: Tensor) -> ThresholdStore:
    outside = ~((values >= 0) & (values < 1))
    if outside.any():
        found = f"{THRESHOLD_COLUMN} outside [0, 1) in {_rows(outside)}"
        remedy = "Export the model again with fragprune export."
        raise ModelFileError(str(path), found, "falloff thresholds", remedy)
    # Whoever merges a pruned model with another fills the column with 0.
    return ThresholdStore.from_falloff(values.clamp_min(1e-30))  # neutral, too
