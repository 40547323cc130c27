"""The sidecar: a safetensors file beside the host's own that carries a threshold store.

``point_cloud.ply`` gets ``point_cloud.fragprune.safetensors``. Its metadata names the model file's
digest and row count, so a pair that does not match is refused. The host's file stays as the host
wrote it. A PLY that fragprune writes has a mark in its header, so a missing sidecar is noticed.
"""

from __future__ import annotations

import json
import math
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import torch

from fragprune_plugins.errors import SidecarError
from fragprune_plugins.learning.finite import expect_finite
from fragprune_plugins.learning.thresholds import ThresholdStore
from fragprune_plugins.storage.atomic import digest, replacing
from fragprune_plugins.storage.ply import is_marked
from fragprune_plugins.storage.reading import Door, parse_json

SUFFIX = ".fragprune.safetensors"
FORMAT = "fragprune-thresholds-1"


@dataclass(frozen=True)
class SidecarInfo:
    """The metadata of a sidecar.

    Attributes:
        rows: number of Gaussians.
        model_sha256: digest of the model file it belongs to.
        adapter: name of the adapter that wrote it, "" when written without a host.
        host_commit: the host checkout's commit, "" when unknown.
        settings: of the fine-tuning.
    """

    rows: int
    model_sha256: str
    adapter: str = ""
    host_commit: str = ""
    settings: dict[str, Any] = field(default_factory=dict)


def path_beside(model: Path) -> Path:
    """The path of a model file's sidecar."""
    return Path(model).with_suffix(SUFFIX)


def lies_beside(model: Path) -> bool:
    """Whether a model file has a sidecar.

    Raises:
        SidecarError: it has none, but was saved with one.
    """
    path = path_beside(model)
    if not path.exists() and is_marked(model):
        raise SidecarError(
            str(path),
            f"no such file, though {Path(model).name} was saved with thresholds beside it",
            "its sidecar, under this name",
            "Copy it here, and always rename both files together. "
            "Or pass --no-truncation to commands that have it.",
        )
    return path.exists()


def belongs(model: Path) -> bool:
    """Whether a model file has a sidecar that was written for the file's present content.

    Raises:
        SidecarError: the sidecar cannot be read.
    """
    return path_beside(model).exists() and _read(model)[1].model_sha256 == digest(model)


def save(
    model: Path,
    store: ThresholdStore,
    *,
    adapter: str = "",
    host_commit: str = "",
    settings: dict[str, Any] | None = None,
) -> Path:
    """Write the store beside an existing model file; returns the sidecar's path.

    Raises:
        DivergedError: learned values are not finite.
        OutputError: the file cannot be written.
    """
    from safetensors.torch import save_file

    expect_finite(store.numbers, str(path_beside(model)))
    state = store.state_dict()
    tensors = {k: v.cpu().contiguous() for k, v in state.items() if isinstance(v, torch.Tensor)}
    metadata = {
        "format": FORMAT,
        "rows": str(len(store)),
        "model_sha256": digest(model),
        "adam_step": repr(state["adam_step"]),
        "steps": str(state["steps"]),
        "adapter": adapter,
        "host_commit": host_commit,
        "settings": json.dumps(settings or {}, sort_keys=True),
    }
    target = path_beside(model)
    with replacing(target) as temporary:
        save_file(tensors, temporary, metadata=metadata)
    return target


def load(
    model: Path, rows: int | None = None, device: torch.device | str = "cpu"
) -> tuple[ThresholdStore, SidecarInfo]:
    """Read the sidecar of a model file.

    Args:
        model: the file.
        rows: of the model, from whoever has it; others are refused. None takes as many as the
            sidecar says that it has.
        device: where the store is to live.

    Raises:
        SidecarError: missing, unreadable, not finite, written for another model file, or of other
            rows than the model.
    """
    state, info = _read(model)
    shape, wanted = tuple(state["logits"].shape), digest(model)
    if wanted != info.model_sha256 or shape != (info.rows,):
        raise SidecarError(
            str(path_beside(model)),
            f"thresholds of another model (sha256 {info.model_sha256[:12]}, {info.rows} rows)",
            f"those of {Path(model).name} (sha256 {wanted[:12]})",
            _remedy(model),
        )
    if rows not in (None, info.rows):
        raise SidecarError(
            str(path_beside(model)),
            f"thresholds of {info.rows} Gaussian(s)",
            f"{rows}, one for each in {Path(model).name}",
            _remedy(model),
        )
    store = ThresholdStore(info.rows, device)
    store.load_state_dict(state)
    return store, info


def _remedy(model: Path) -> str:
    return f"Remove {path_beside(model).name}, or write it again with fragprune finetune."


def _read(model: Path) -> tuple[dict[str, Any], SidecarInfo]:
    """Read a sidecar's store state and metadata, without a look at the model beside it."""
    from safetensors import safe_open

    remedy = _remedy(model)
    door = Door(SidecarError, "unreadable", f"a file of format {FORMAT}", remedy, missing=remedy)
    with door.reading(path_beside(model)) as reading:
        reading.place = "its header"
        with safe_open(reading.path, framework="pt") as file:
            reading.place = "its metadata"
            metadata = file.metadata() or {}
            if metadata["format"] != FORMAT:
                raise ValueError(f"format {metadata['format'][:80]!r}")
            info = SidecarInfo(
                rows=int(metadata["rows"]),
                model_sha256=metadata["model_sha256"],
                adapter=metadata["adapter"],
                host_commit=metadata["host_commit"],
                settings=parse_json(metadata["settings"]),
            )
            state = {"adam_step": float(metadata["adam_step"]), "steps": int(metadata["steps"])}
            if not isinstance(info.settings, dict):
                raise ValueError("settings that are no object")
            if not (0 <= state["adam_step"] < math.inf and 0 <= state["steps"] < 1 << 63):
                raise ValueError(f"{state['adam_step']:g} and {state['steps']} steps")
            tensors: dict[str, torch.Tensor] = {}
            for name in ("logits", "exp_avg", "exp_avg_sq"):
                reading.place = f"tensor {name}"
                tensors[name] = file.get_tensor(name)
                if tensors[name].dtype != torch.float32:
                    raise ValueError(f"{tensors[name].dtype}, not torch.float32")
    return tensors | state, info
