"""Loads models of any format with their thresholds, writes them, and says what was written."""

from __future__ import annotations

import contextlib
import os
import tempfile
from dataclasses import replace
from functools import cache
from pathlib import Path
from typing import Protocol

import torch

from fragprune_plugins.errors import ModelFileError, OutputError, SidecarError, UsageError, log
from fragprune_plugins.files import sidecar
from fragprune_plugins.files.atomic import put, staging
from fragprune_plugins.files.model import Model
from fragprune_plugins.learning.finite import expect_finite
from fragprune_plugins.workbench.models import formats

_STEP = 0.1  # of a Gaussian's width: pictures were 57 dB from exact ones at 0.02, 22 dB at 2
_warn = cache(log.warning)  # once, because commands read a file several times
DEFORMATION = "deformation.pth"  # the network that 4DGaussians saves beside a PLY


class Trained(Protocol):
    """The result of a training, such as ``FinetuneResult``."""

    @property
    def model(self) -> Model:
        """What was trained."""


def of(given: Model | Trained | str | Path) -> Model:
    """A model as it is, out of a result, or from its file, as ``load`` reads it."""
    if isinstance(given, str | Path):
        return load(given)
    return given if isinstance(given, Model) else given.model


def load(
    path: str | Path,
    *,
    truncation: bool = True,
    filtered: bool = False,
    device: torch.device | str = "cpu",
) -> Model:
    """Read a model and its thresholds: the file's own, else the sidecar's of a PLY, else None.

    Args:
        path: of the model, in any format of ``formats``.
        truncation: False ignores thresholds.
        filtered: accept a model that the caller draws by its host's rules; see ``read_ply``.
        device: the device of the result.

    Raises:
        ModelFileError: the model cannot be read, or is drawn only after a network has moved it.
        SidecarError: the sidecar is broken, another model's, or has another number of rows.
    """
    path = Path(path)
    if path.is_dir():  # of some, such as ".", no file beside them has a name
        remedy = "Pass the point_cloud.ply that a 3DGS training saved."
        raise ModelFileError(str(path), "a folder", "a trained splat's file", remedy)
    if path.with_name(DEFORMATION).exists():
        moved = f"the network beside them ({DEFORMATION}) moves them for each moment"
        found, expected = f"Gaussians that no view shows: {moved}", "a model that one file holds"
        remedy = "Draw it with its training code: fragprune run -- python render.py -m OUTPUT."
        raise ModelFileError(str(path), found, expected, remedy)
    paired = truncation and formats.found(path).paired
    while True:  # until nobody replaced the pair meanwhile
        before = _versions(path)
        try:
            model = formats.read(path, filtered=filtered).to(device)
            if paired and model.thresholds is None and sidecar.find(path):
                model = replace(model, thresholds=sidecar.load(path, len(model), device)[0])
        except SidecarError:
            if _versions(path) == before:
                raise
        else:
            if _versions(path) == before:
                _warn_if_far(path, model)
                _warn_if_activated(path, model)
                return model if truncation and model.pruned else model.untruncated()


def _warn_if_far(path: Path, model: Model) -> None:
    """Warn of positions, as of georeferenced scenes, at which float32 has too wide steps."""
    far, wide = model.xyz.abs().amax(dim=1), model.scaling.amax(dim=1).exp()
    step, size = (float(each.median()) for each in (far * torch.finfo(far.dtype).eps, wide))
    if step > _STEP * size:
        _warn(
            f"{path}: it lies so far from the origin that float32 has steps of {step:.2g} world "
            f"units there, and half of its Gaussians are no wider than {size:.2g}: its pictures "
            "are wrong by as much. Move the cameras to the origin, and train there"
        )


def _warn_if_activated(path: Path, model: Model) -> None:
    """Warn of values as a program has them that forgot to undo the activation when it saved."""
    opacity = model.opacity
    if bool((opacity >= 0).all() and (opacity <= 1).all() and (model.scaling > 0).all()):
        _warn(
            f"{path}: all opacities lie between 0 and 1, and all scales above 0, as if they had "
            "been saved after activation. They are read as logits and logarithms, as 3DGS saves "
            "them; save logit(opacity) and log(scale)"
        )


def _versions(path: Path) -> list[tuple[int, ...] | None]:
    """What changes when another process replaces a model or its sidecar."""
    found: list[tuple[int, ...] | None] = [None, None]
    for index, each in enumerate((path, sidecar.path_beside(path))):
        with contextlib.suppress(OSError):
            stat = each.stat()
            found[index] = (stat.st_ino, stat.st_mtime_ns, stat.st_size)
    return found


def save(path: str | Path, model: Model | Trained) -> None:
    """Write a model with its thresholds, or the result of a training, whole or not at all.

    The suffix names the format. A PLY holds thresholds in the column ``trunc_threshold``, other
    formats by extensions of theirs. The sidecar of a host's earlier PLY of this name goes with it.

    Raises:
        OutputError: the place cannot be written, its name is no model's, the format cannot hold
            thresholds, or there is no Gaussian; existing files stay as they were.
        DivergedError: values are not finite.
    """
    path, model = Path(path), of(model)
    form = formats.named(path)
    learned = {} if model.thresholds is None else model.thresholds.numbers
    expect_finite(model.tensors | learned, str(path))
    if not len(model):
        expected, remedy = "at least one", "Keep some: no command reads a file without any."
        raise OutputError(str(path), "0 Gaussians", expected, remedy)
    with staging(path) as folder:
        new = folder / path.name
        try:
            formats.write(form, new, model)
        except OutputError as error:  # it knows the name for the meantime only
            raise OutputError(str(path), error.found, error.expected, error.remedy) from error
        if form.paired:
            sidecar.replace_pair(path, new, None)
        else:
            put(new, path)


def writable_folder(path: Path) -> Path:
    """Create the folder if it is missing; returns it. OutputError if no file can be made in it."""
    path = Path(path)
    try:
        path.mkdir(parents=True, exist_ok=True)
        with tempfile.TemporaryFile(dir=path):
            pass
    except OSError as error:
        found = f"cannot be written ({error.strerror or error})"
        expected = "a folder one can write to"
        raise OutputError(str(path), found, expected, "Choose another output folder.") from error
    return path


def require_place(out: Path, model: Path, *, thresholds: bool = True) -> None:
    """Check, before any work, that ``out`` can be written, and thresholds into its format.

    It is a UsageError if it has the name of ``model``, or of two PLYs that of their sidecar.
    """
    form = formats.named(out)
    if thresholds:
        formats.expect_carrier(form, out)
    own, other = (Path(os.path.realpath(path)) for path in (out, model))  # a loop does not raise
    if form.paired and other.suffix.lower() == ".ply":
        own, other = own.with_suffix(""), other.with_suffix("")
    if own == other:
        found = f"{out}, the model's name"
        raise UsageError("--out", found, "another name", "Choose another name.")
    writable_folder(out.parent)
    if out.exists() and not out.is_file():
        found = "a folder" if out.is_dir() else "a pipe or device"
        raise OutputError(str(out), found, f"a {form.suffix} file", "Choose another name.")


def describe_written(out: Path, held: str = "", *, pruned: bool = True) -> str:
    """What a model was written into, how it holds thresholds, and what its format does not keep."""
    form = formats.named(out)
    cut = f", and cutoffs {form.thresholds}" if pruned and form.thresholds else ""
    kept = f" A {form.suffix} file keeps {form.keeps}{cut}." if form.keeps else ""
    return f"Wrote {out}{held}.{kept}"
