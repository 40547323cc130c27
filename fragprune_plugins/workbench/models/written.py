"""Where a result is to be written, and what a person is told of the file."""

from __future__ import annotations

import os
import tempfile
from pathlib import Path

from fragprune_plugins.errors import OutputError, UsageError
from fragprune_plugins.workbench.models import formats


def writable_folder(path: Path) -> Path:
    """Create the folder if it is missing, and check that a file can be made in it; returns it.

    Raises:
        OutputError: the folder cannot be written.
    """
    path = Path(path)
    try:
        path.mkdir(parents=True, exist_ok=True)
        with tempfile.TemporaryFile(dir=path):
            pass
    except OSError as error:
        raise OutputError(
            str(path),
            f"cannot be written ({error.strerror or error})",
            "a folder one can write to",
            "Choose another output folder.",
        ) from error
    return path


def require_place(out: Path, model: Path, *, thresholds: bool = True) -> None:
    """Check, before any work, that ``out`` can be written and is not ``model``.

    Args:
        out: the model to write, of any format.
        model: the model to read.
        thresholds: whether ``out`` is to have thresholds.

    Raises:
        UsageError: ``out`` and ``model`` have the same name, or of two PLYs that of their sidecar.
        OutputError: ``out`` cannot be written, or its format cannot hold thresholds.
    """
    form = formats.named(out)
    if thresholds:
        formats.expect_carrier(form, out)
    own, other = (Path(os.path.realpath(path)) for path in (out, model))  # a loop does not raise
    if form.paired and other.suffix.lower() == ".ply":
        own, other = own.with_suffix(""), other.with_suffix("")
    if own == other:
        raise UsageError(
            "--out", f"{out}, the model's name", "another name", "Choose another name."
        )
    writable_folder(out.parent)
    if out.is_dir():
        raise OutputError(
            str(out), "a folder", f"a {form.suffix} file", "Name a file in the folder."
        )


def describe_written(out: Path, held: str = "", *, pruned: bool = True) -> str:
    """What a model was written into, and what its format does not keep.

    Args:
        held: how it holds thresholds, as words; "" where there are none.
        pruned: whether the model has thresholds.
    """
    form = formats.named(out)
    cut = f", and cutoffs {form.thresholds}" if pruned and form.thresholds else ""
    kept = f" A {form.suffix} file keeps {form.keeps}{cut}." if form.keeps else ""
    return f"Wrote {out}{held}.{kept}"
