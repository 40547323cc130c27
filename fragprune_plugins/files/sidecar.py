"""The sidecar: a safetensors file beside the host's own that carries a threshold store.

``point_cloud.ply`` gets ``point_cloud.fragprune.safetensors``. Its metadata names the model file's
digest and row count, so a pair that does not match is refused. What fragprune writes itself holds
its thresholds in its own column, and has no sidecar.

``replace_pair`` renames twice, and the renaming of the model is what counts. Before it, a sidecar
whose model is not there yet lies under an address that the model's digest gives; after it, the
sidecar moves to its usual name. A reader looks at the address first. So model and sidecar are both
the old ones, or both the new ones, whatever ends the process.
"""

from __future__ import annotations

import json
import math
import os
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import torch
from safetensors import SafetensorError, safe_open
from safetensors.torch import save_file

from fragprune_plugins.errors import SidecarError
from fragprune_plugins.files import atomic
from fragprune_plugins.files.atomic import all_in_flight, digest
from fragprune_plugins.files.ply import read_thresholds
from fragprune_plugins.files.reading import UntrustedFile, parse_json
from fragprune_plugins.learning.finite import expect_finite
from fragprune_plugins.learning.thresholds import ThresholdStore

SUFFIX = ".fragprune.safetensors"
FORMAT = "fragprune-thresholds-1"


@dataclass(frozen=True)
class SidecarInfo:
    """The metadata of a sidecar."""

    rows: int  # Gaussians
    model_sha256: str  # of the model file it belongs to
    adapter: str = ""  # that wrote it, "" without a host
    host_commit: str = ""  # "" if unknown
    settings: dict[str, Any] = field(default_factory=dict)


def path_beside(model: Path) -> Path:
    """The path of a model file's sidecar."""
    return Path(model).with_suffix(SUFFIX)


def thresholds_of(
    model: Path, rows: int, device: torch.device | str = "cpu"
) -> ThresholdStore | None:
    """The thresholds of a file that a host reads: its own column's, else its sidecar's, else None.

    ModelFileError or SidecarError if they cannot be read, or are another model's.
    """
    store = read_thresholds(model)
    if store is not None:
        return store.clone(device)
    return load(model, rows, device)[0] if find(model) else None


def belongs(model: Path) -> bool:
    """Whether a model file has a sidecar that was written for the file's present content."""
    path = find(model)
    return path is not None and _read(model, path)[1].model_sha256 == digest(model)


def find(model: Path) -> Path | None:
    """The sidecar to read with a model file: at the address of its content, else beside it."""
    model, path = Path(model), path_beside(model)
    if (waiting := all_in_flight(model, _ADDRESSES)) and model.is_file():
        addressed = _address(model, digest(model))
        if addressed in waiting:
            return addressed
    return path if os.path.exists(path) else None  # also for too long a name


def save(model: Path, store: ThresholdStore, **about: Any) -> Path:
    """Write the store beside an existing model file, which stays; returns the sidecar's path.

    Args:
        about: adapter, host_commit and settings, as ``SidecarInfo`` has them.

    Raises:
        DivergedError: learned values are not finite.
        OutputError: the file cannot be written.
    """
    target = path_beside(model)
    if all_in_flight(model, _ADDRESSES):  # a dead process left it there: it would be read first
        with atomic.locked(model):
            _tidy(model)
    with atomic.replacing(target, durable=True) as new:
        _write(new, store, SidecarInfo(len(store), digest(model), **about))
    return target


def replace_pair(path: Path, whole: Path, store: ThresholdStore | None, **about: Any) -> None:
    """Put a finished model file and its thresholds in the place of a model and its sidecar.

    Args:
        whole: the finished file, in a folder that ``atomic.staging`` gave for ``path``.
        store: its thresholds; None for a model without a sidecar.
        about: as in ``save``.

    Raises:
        DivergedError: learned values are not finite; the old pair stays.
        OSError: a file cannot be written; the old pair stays, or the new one is there.
    """
    beside = path_beside(path)
    _tidy(path)
    try:
        if store is not None:
            sha = digest(whole)
            new = whole.with_name(beside.name)
            _write(new, store, SidecarInfo(len(store), sha, **about))
            atomic.put(new, _address(path, sha))
        elif beside.exists():  # it stays with the old model for as long as that is there
            atomic.rename(beside, _address(path, digest(path) if path.is_file() else "none"))
        atomic.put(whole, path)
        if store is None:  # also where the model kept its bytes, and so its address
            for each in all_in_flight(path, _ADDRESSES):
                each.unlink()
    finally:
        _tidy(path)


def _tidy(model: Path) -> None:
    """Move a model's sidecar from its address to its usual name, and remove all other addresses."""
    waiting = all_in_flight(model, _ADDRESSES)
    addressed = _address(model, digest(model)) if waiting and model.is_file() else None
    for each in waiting:
        if each == addressed:
            atomic.rename(each, path_beside(model))
        else:
            each.unlink()


_ADDRESSES = "for-*"


def _address(model: Path, sha: str) -> Path:
    """Where a sidecar lies whose model has this digest and is not, or no longer, in place."""
    return atomic.in_flight(model, f"for-{sha[:32]}")


def _write(path: Path, store: ThresholdStore, info: SidecarInfo) -> None:
    expect_finite(store.numbers, str(path_beside(path)))
    state = store.state_dict()
    tensors = {k: v.cpu().contiguous() for k, v in state.items() if isinstance(v, torch.Tensor)}
    metadata = {
        "format": FORMAT,
        "rows": str(info.rows),
        "model_sha256": info.model_sha256,
        "adam_step": repr(state["adam_step"]),
        "steps": str(state["steps"]),
        "adapter": info.adapter,
        "host_commit": info.host_commit,
        "settings": json.dumps(info.settings, sort_keys=True),
    }
    if store.stop is not None:
        metadata["stop"] = repr(store.stop)
    if store.rim != "hard":
        metadata["rim"] = store.rim
    try:
        save_file(tensors, path, metadata=metadata)
    except SafetensorError as error:  # that is how it says that the disk is full
        raise OSError(str(error)) from error


def load(
    model: Path, rows: int | None = None, device: torch.device | str = "cpu"
) -> tuple[ThresholdStore, SidecarInfo]:
    """Read the sidecar of a model file.

    Args:
        rows: of the model, others are refused; None takes as many as the sidecar says that it has.

    Raises:
        SidecarError: missing, unreadable, not finite, or written for another model file or rows.
    """
    state, info = _read(model, find(model) or path_beside(model))
    shape, wanted, name = tuple(state["logits"].shape), digest(model), Path(model).name
    if wanted != info.model_sha256 or shape != (info.rows,):
        found = f"thresholds of another model (sha256 {info.model_sha256[:12]}, {info.rows} rows)"
        expected = f"those of {name} (sha256 {wanted[:12]})"
    elif rows not in (None, info.rows):
        found = f"thresholds of {info.rows} Gaussian(s)"
        expected = f"{rows}, one for each in {name}"
    else:
        store = ThresholdStore(0, device)
        try:
            store.load_state_dict(state)
        except SidecarError as error:
            found, expected = error.found, error.expected
        else:
            return store, info
    raise SidecarError(str(path_beside(model)), found, expected, _remedy(model))


def _remedy(model: Path) -> str:
    return f"Remove {path_beside(model).name}, or write it again with fragprune finetune."


def _read(model: Path, path: Path) -> tuple[dict[str, Any], SidecarInfo]:
    """Read a sidecar's state, which the store checks, and its metadata; the model is not read."""
    expected, remedy = f"a file of format {FORMAT}", _remedy(model)
    kind = UntrustedFile(SidecarError, "unreadable", expected, remedy, missing=remedy)
    with kind.reading(path) as reading:
        reading.place = "its header"
        with safe_open(reading.path, framework="pt") as file:
            reading.place = "its metadata"
            metadata = file.metadata() or {}
            if metadata["format"] != FORMAT:
                raise ValueError(f"format {metadata['format'][:80]!r}")
            named = {name: metadata[name] for name in ("model_sha256", "adapter", "host_commit")}
            settings, rows = parse_json(metadata["settings"]), int(metadata["rows"])
            info = SidecarInfo(rows, **named, settings=settings)
            if not isinstance(info.settings, dict):
                raise ValueError("settings that are no object")
            state = {"adam_step": float(metadata["adam_step"]), "steps": int(metadata["steps"])}
            state |= {"stop": float(metadata["stop"])} if "stop" in metadata else {}
            if not (0 <= state["adam_step"] < math.inf and 0 <= state["steps"] < 1 << 63):
                raise ValueError(f"{state['adam_step']:g} and {state['steps']} steps")
            tensors: dict[str, Any] = {"rim": metadata.get("rim", "hard")}
            for name in ("logits", "exp_avg", "exp_avg_sq"):
                reading.place = f"tensor {name}"
                tensors[name] = file.get_tensor(name)
    return tensors | state, info
