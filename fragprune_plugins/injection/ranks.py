"""Refuses to learn in several processes that train one model together."""

from __future__ import annotations

import os
from pathlib import Path

import torch

from fragprune_plugins.errors import RanksError

_LAUNCHERS = {"torchrun", "torch.distributed.run", "torch.distributed.launch", "accelerate"}


def expect_one() -> None:
    """Check that this process trains alone: a store would learn from the views of one rank only."""
    said = os.environ.get("WORLD_SIZE", "")
    ranks, found = int(said) if said.isdigit() else 1, f"WORLD_SIZE={said} in the environment"
    if torch.distributed.is_available() and torch.distributed.is_initialized():
        ranks = torch.distributed.get_world_size()
        found = f"torch.distributed with {ranks} processes"
    if ranks > 1:
        remedy = "Train in several processes without fragprune. Then learn: fragprune run --stage "
        remedy += "finetune without torchrun, or torchrun -m fragprune_plugins finetune in several."
        raise RanksError("learning", found, "one process that trains the model", remedy)


def expect_no_launcher(command: list[str]) -> None:
    """Check that a host's command does not start several processes."""
    words = [Path(word).name for word in command[:3]]
    if words and words[0].startswith("python") and words[1:2] == ["-m"]:
        words = words[2:]
    if words and words[0] in _LAUNCHERS:
        expected = "the host's own script, in one process"
        remedy = "Leave the launcher out: -- python train.py ... To use several GPUs, train "
        remedy += "without fragprune, then torchrun -m fragprune_plugins finetune."
        raise RanksError("command", f"{words[0]}, which starts several processes", expected, remedy)
