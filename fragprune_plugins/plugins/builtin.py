"""The defaults, as a plugin like any other; it answers last."""

from __future__ import annotations

from typing import TYPE_CHECKING

from fragprune_plugins.plugins.hookspecs import hookimpl

if TYPE_CHECKING:
    import torch
    from torch import Tensor

    from fragprune_plugins.engines import Engine
    from fragprune_plugins.learning.schedule import Schedule, Settings
    from fragprune_plugins.learning.thresholds import ThresholdStore


@hookimpl(trylast=True)
def fragprune_truncate(store: ThresholdStore) -> Tensor | None:
    """The learned thresholds."""
    return None if store.neutral else store.values


@hookimpl(trylast=True)
def fragprune_create_engine(name: str, device: torch.device) -> Engine:
    """Our own engines."""
    from fragprune_plugins.engines import create_engine

    return create_engine(name, device)


@hookimpl(trylast=True)
def fragprune_create_schedule(settings: Settings) -> Schedule:
    """Stage 2 as the paper has it."""
    from fragprune_plugins.learning.schedule import Schedule

    return Schedule(settings)
