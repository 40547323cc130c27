"""What experiments measure: models with their thresholds, on the views of photographs."""

from __future__ import annotations

import hashlib
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import torch

from fragprune_plugins.engines import Engine
from fragprune_plugins.files.atomic import digest
from fragprune_plugins.hosts.photographs import Photographs
from fragprune_plugins.workbench.bench.timing import describe_machine
from fragprune_plugins.workbench.figures import records
from fragprune_plugins.workbench.figures.evaluate import Candidate
from fragprune_plugins.workbench.figures.records import plain
from fragprune_plugins.workbench.models import model as models
from fragprune_plugins.workbench.scenes.dataset import Dataset


def load_columns(
    paths: Sequence[Path], device: torch.device
) -> tuple[dict[str, Candidate], dict[str, Any]]:
    """The columns of a table, by label, and what they are, as plain values.

    Each model is drawn with its thresholds. One model alone is drawn without them and with them.

    Args:
        paths: of the models; a label is a file's name, or its path if two names are equal.
        device: of the models.

    Raises:
        ModelFileError: a model cannot be read.
        SidecarError: its thresholds cannot.
    """
    names = [path.stem for path in paths]
    labels = names if len(set(names)) == len(names) else [str(path) for path in paths]
    columns: dict[str, Candidate] = {}
    said: dict[str, Any] = {}
    for label, path in zip(labels, paths, strict=True):
        model = models.load(path, device=device)
        said[label] = {"sha256": digest(path), "thresholds": None, "learned": None}
        if model.falloff is not None:
            values = model.falloff.cpu().numpy().tobytes()
            said[label]["thresholds"] = hashlib.sha256(values).hexdigest()
        if record := records.beside(path):
            said[label]["learned"] = record.data.get("settings")
        if model.falloff is not None and len(paths) == 1:
            columns[f"{label}, untruncated"] = Candidate(model.untruncated())
        columns[label] = Candidate(model)
    return columns, said


def describe_photographs(photographs: Photographs, dataset: Dataset) -> dict[str, Any]:
    """What photographs are, as plain values, wherever they lie."""
    return plain(photographs) | {
        "folder": photographs.folder.resolve().name,
        "sha256": _digest(dataset),
        "training_views": len(dataset.train),
        "held_out_views": len(dataset.test),
    }


def describe_drawing(engine: Engine, device: torch.device) -> dict[str, Any]:
    """What draws, and on what, as plain values."""
    return {
        "engine": engine.name,
        "device": str(device),
        "threads": torch.get_num_threads(),
        "machine": describe_machine(device),
    }


def _digest(dataset: Dataset) -> str:
    """The SHA-256 digest of the photographs and their cameras."""
    sha = hashlib.sha256()
    for shot in (*dataset.train, *dataset.test):
        sha.update(shot.name.encode())
        sha.update((255 * shot.image).round().byte().cpu().numpy().tobytes())
        sha.update(shot.view.projmatrix.cpu().numpy().tobytes())
    return sha.hexdigest()
