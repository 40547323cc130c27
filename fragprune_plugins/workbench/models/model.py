"""Loads a model with its thresholds, from the sidecar or from the file itself."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

if TYPE_CHECKING:
    import torch

    from fragprune_plugins.files.ply import SplatFile
    from fragprune_plugins.learning.thresholds import ThresholdStore


DEFORMATION = "deformation.pth"
"""The network that 4DGaussians saves beside a PLY."""


class Model(NamedTuple):
    """A trained splat and how far each of its Gaussians reaches.

    Attributes:
        splat: the N Gaussians, as their file holds them.
        thresholds: one for each; None where nothing is truncated.
    """

    splat: SplatFile
    thresholds: ThresholdStore | None = None


def load(
    path: str | Path,
    *,
    truncation: bool = True,
    filtered: bool = False,
    device: torch.device | str = "cpu",
) -> Model:
    """Read a model and its thresholds: the sidecar's, else the file's own, else None.

    Args:
        path: of the model, in any format of ``storage/formats``. Only a PLY has a sidecar.
        truncation: False ignores thresholds.
        filtered: accept a model that the caller draws by its host's rules; see ``read_ply``.
        device: the device of the result.

    Raises:
        ModelFileError: the model cannot be read, or is drawn only after a network has moved it.
        SidecarError: the sidecar is lost, broken, another model's, or has another number of rows.
    """
    from fragprune_plugins.errors import SidecarError
    from fragprune_plugins.files import sidecar
    from fragprune_plugins.learning.thresholds import ThresholdStore
    from fragprune_plugins.workbench.models import formats

    path = Path(path)
    _expect_whole(path)
    paired = truncation and formats.found(path).paired
    while True:  # until nobody replaced the pair meanwhile
        before = _versions(path)
        try:
            splat = formats.read(path, filtered=filtered).to(device)
            store = ThresholdStore(len(splat), device)
            if paired and sidecar.lies_beside(path):
                store, _ = sidecar.load(path, len(splat), device)
            elif truncation and splat.thresholds is not None:
                store = ThresholdStore.from_falloff(splat.thresholds)
        except SidecarError:
            if _versions(path) == before:
                raise
        else:
            if _versions(path) == before:
                return Model(splat, None if store.neutral else store)


def _expect_whole(path: Path) -> None:
    """Raise ModelFileError if the file is drawn only after a network has moved its Gaussians."""
    from fragprune_plugins.errors import ModelFileError

    if path.with_name(DEFORMATION).exists():
        raise ModelFileError(
            str(path),
            f"Gaussians that no view shows: the network beside them ({DEFORMATION}) moves them for "
            "each moment",
            "a model that one file holds",
            "Draw it with its training code: fragprune run -- python render.py -m OUTPUT.",
        )


def _versions(path: Path) -> list[tuple[int, ...] | None]:
    """What changes when another process replaces a model or its sidecar."""
    from fragprune_plugins.files import sidecar

    found: list[tuple[int, ...] | None] = []
    for each in (path, sidecar.path_beside(path)):
        try:
            stat = each.stat()
            found.append((stat.st_ino, stat.st_mtime_ns, stat.st_size))
        except OSError:
            found.append(None)
    return found


def save_plain(path: str | Path, splat: SplatFile) -> None:
    """Write a model that has no thresholds, for any viewer: no sidecar, no mark in the file.

    The sidecar of an earlier PLY of this name goes with that model.

    Raises:
        OutputError: the place cannot be written, or its name is no model's; existing files stay as
            they were.
    """
    from fragprune_plugins.files import sidecar
    from fragprune_plugins.files.atomic import replacing, staging
    from fragprune_plugins.files.ply import write_ply
    from fragprune_plugins.workbench.models import formats

    path = Path(path)
    form = formats.named(path)
    if not form.paired:
        with replacing(path, durable=True) as new:
            formats.write(form, new, splat, None)
        return
    with staging(path) as folder:
        whole = folder / path.name
        write_ply(whole, splat)
        sidecar.replace_pair(path, whole, None)


def save(path: str | Path, model: Model, *, settings: dict[str, Any] | None = None) -> Path:
    """Write a model with its thresholds, whole or not at all, as ``fragprune finetune`` does.

    Args:
        path: of the model; its suffix names the format. A PLY gets a sidecar beside it,
            ``NAME.fragprune.safetensors``; other formats hold thresholds themselves.
        model: what to write.
        settings: recorded in the sidecar, such as ``Settings.as_dict`` gives.

    Returns:
        The path of the file that holds the thresholds: the sidecar's, or the model's.

    Raises:
        OutputError: the place cannot be written, its name is no model's, or the format cannot hold
            thresholds; existing files stay as they were.
        AlignmentError: splat and thresholds differ in length.
        DivergedError: learned values are not finite.
    """
    from fragprune_plugins.errors import AlignmentError
    from fragprune_plugins.files import sidecar
    from fragprune_plugins.files.atomic import replacing, staging
    from fragprune_plugins.files.ply import write_ply
    from fragprune_plugins.learning.finite import expect_finite
    from fragprune_plugins.learning.thresholds import ThresholdStore
    from fragprune_plugins.workbench.models import formats

    path, (splat, store) = Path(path), model
    store = ThresholdStore(len(splat)) if store is None else store
    form = formats.named(path)
    if len(store) != len(splat):
        raise AlignmentError(
            str(path),
            f"a store of {len(store)} thresholds",
            f"{len(splat)}, one per Gaussian",
            "Pass the store of this very model.",
        )
    if not form.paired:
        expect_finite(store.numbers, str(path))
        with replacing(path, durable=True) as new:
            formats.write(form, new, splat, None if store.neutral else store.values.detach())
        return path
    with staging(path) as folder:
        whole = folder / path.name
        write_ply(whole, splat, marked=not store.neutral)
        sidecar.replace_pair(path, whole, store, settings=settings)
    return sidecar.path_beside(path)
