"""Our own engines as a plugin: it is registered first, and so asked last."""

from __future__ import annotations

from typing import TYPE_CHECKING

from fragprune_plugins.engines import ENGINES, Engine, create_engine
from fragprune_plugins.plugins.hookspecs import hookimpl

if TYPE_CHECKING:
    import torch

NAME = "fragprune"
"""Under which it is registered. What it raises is stated already, and is no fault of a plugin."""


@hookimpl
def fragprune_create_engine(name: str, device: torch.device) -> Engine | None:
    """Ours, for our own names; None for others."""
    return create_engine(name, device) if name in ("auto", *ENGINES) else None
