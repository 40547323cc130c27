"""A model with its thresholds, wherever these are: in the sidecar, or in the file itself."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from torch import Tensor

    from fragprune_plugins.learning.thresholds import ThresholdStore
    from fragprune_plugins.storage.ply import SplatFile


def load_model(
    path: Path, *, truncation: bool = True, filtered: bool = False
) -> tuple[SplatFile, Tensor | None]:
    """A model and its thresholds (N,): the sidecar's, else the file's own column, else None.

    ``filtered`` as in ``read_ply``.

    Raises:
        ModelFileError: the model cannot be read.
        SidecarError: the sidecar beside it is broken, belongs to another model or has other rows.
    """
    from fragprune_plugins.storage import sidecar
    from fragprune_plugins.storage.ply import read_ply

    model = read_ply(path, filtered=filtered)
    if not truncation:
        return model, None
    if sidecar.path_beside(path).exists():
        store = load_store(path, model)
        return model, None if store.neutral else store.values.detach()
    return model, model.thresholds


def load_store(path: Path, model: SplatFile) -> ThresholdStore:
    """The thresholds of a model to go on learning from: as ``load_model``, neutral when none."""
    import torch

    from fragprune_plugins.learning.thresholds import ThresholdStore
    from fragprune_plugins.storage import sidecar

    store = ThresholdStore(len(model))
    if sidecar.path_beside(path).exists():
        sidecar.load(path, store)
    elif model.thresholds is not None:
        with torch.no_grad():
            store.logits.copy_(torch.logit(model.thresholds))
    return store
