"""A checkpoint of a fine-tuning: tensors and plain values in one file, whole or absent."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import torch
from safetensors import SafetensorError, safe_open
from safetensors.torch import save_file
from torch import Tensor

from fragprune_plugins.errors import CheckpointError, SidecarError
from fragprune_plugins.files.atomic import replacing
from fragprune_plugins.files.reading import UntrustedFile, parse_json
from fragprune_plugins.learning.finite import expect_finite

FORMAT = "fragprune-checkpoint-1"
UNFIT = (
    *(KeyError, ValueError, TypeError, IndexError, RuntimeError, AttributeError, OverflowError),
    SidecarError,
)
"""What is raised where the parts of a checkpoint do not fit what they are loaded into."""

_REMEDY = "Remove it, or begin anew with --again."
_FILE = UntrustedFile(CheckpointError, "unreadable", f"a file of format {FORMAT}", _REMEDY)


def save(path: Path, tensors: dict[str, Tensor], values: dict[str, Any]) -> None:
    """Write a checkpoint durably in the place of the one before.

    Args:
        values: whatever JSON can hold; floats come back to the bit.

    Raises:
        DivergedError: a tensor holds NaN or infinity.
        OutputError: the file cannot be written. The one before stays.
    """
    expect_finite({k: each for k, each in tensors.items() if k != "curves"}, str(path))
    content = {name: tensor.detach().cpu().contiguous() for name, tensor in tensors.items()}
    with replacing(path, durable=True) as new:
        try:
            save_file(content, new, metadata={"format": FORMAT, "values": json.dumps(values)})
        except SafetensorError as error:  # that is how it says that the disk is full
            raise OSError(str(error)) from error


def load(
    path: Path, device: torch.device | str = "cpu"
) -> tuple[dict[str, Tensor], dict[str, Any]]:
    """Read the tensors and values of a checkpoint.

    Raises:
        CheckpointError: it cannot be read, or holds NaN or infinity.
    """
    with _FILE.reading(path) as reading, safe_open(reading.path, framework="pt") as file:
        metadata = file.metadata()
        if metadata["format"] != FORMAT:
            raise ValueError(f"format {metadata['format'][:80]!r}")
        values = parse_json(metadata["values"])
        # copies: views into the file may lie in memory where other bits are rounded
        tensors = {key: file.get_tensor(key).clone().to(device) for key in file.keys()}  # noqa: SIM118
    wrong = [name for name, tensor in tensors.items() if _is_broken(name, tensor)]
    if wrong or not isinstance(values, dict):
        found = f"numbers that cannot be in {', '.join(wrong)}" if wrong else "no values"
        raise CheckpointError(str(path), found, "what a fine-tuning wrote", _REMEDY)
    return tensors, values


def _is_broken(name: str, tensor: Tensor) -> bool:
    """Whether a tensor holds NaN or infinity, or is a negative second moment."""
    if name == "curves":  # a loss that is not known is NaN
        return False
    negative = "exp_avg_sq" in name and bool((tensor < 0).any())
    return negative or not bool(tensor.isfinite().all())
