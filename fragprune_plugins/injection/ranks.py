"""Refuses to learn in several processes that train one model together."""

from __future__ import annotations

import os

from fragprune_plugins.errors import RanksError


def expect_one() -> None:
    """Check that this process trains alone.

    The store of thresholds would learn from one rank's views only, and each rank would write its
    own sidecar.

    Raises:
        RanksError: torchrun or another launcher set WORLD_SIZE, or the host has initialized
            ``torch.distributed``, with more than one process.
    """
    import torch

    said = os.environ.get("WORLD_SIZE", "")
    ranks = int(said) if said.isdigit() else 1
    found = f"WORLD_SIZE={said} in the environment"
    if torch.distributed.is_available() and torch.distributed.is_initialized():
        ranks = torch.distributed.get_world_size()
        found = f"torch.distributed with {ranks} processes"
    if ranks > 1:
        raise RanksError(
            "learning",
            found,
            "one process that trains the model",
            "Train in several processes without fragprune. Then learn in one process: "
            "fragprune run --stage finetune without torchrun, or fragprune finetune.",
        )
