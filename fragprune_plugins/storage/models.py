"""A model with its thresholds, wherever these are: in the sidecar, or in the file itself."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    import torch

    from fragprune_plugins.learning.thresholds import ThresholdStore
    from fragprune_plugins.storage.ply import SplatFile


def load_model(
    path: Path,
    *,
    truncation: bool = True,
    filtered: bool = False,
    device: torch.device | str = "cpu",
) -> tuple[SplatFile, ThresholdStore | None]:
    """A model and its thresholds: the sidecar's, else the file's own column, else None.

    Args:
        path: of the model.
        truncation: False leaves the thresholds out.
        filtered: as in ``read_ply``.
        device: where both are to live.

    Raises:
        ModelFileError: the model cannot be read.
        SidecarError: the sidecar beside it is lost, broken, another model's, or has other rows.
    """
    import torch

    from fragprune_plugins.learning.thresholds import ThresholdStore
    from fragprune_plugins.storage import sidecar
    from fragprune_plugins.storage.ply import read_ply

    model = read_ply(path, filtered=filtered).to(device)
    store = ThresholdStore(len(model), device)
    if truncation and sidecar.lies_beside(path):
        store, _ = sidecar.load(path, len(model), device)
    elif truncation and model.thresholds is not None:
        store.place(torch.logit(model.thresholds))
    return model, None if store.neutral else store
