"""fragprune: learned fragment pruning for every Gaussian-splatting codebase.

Importing this package imports neither torch nor any host; names load when they are first used.
"""

from __future__ import annotations

from importlib import import_module
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from fragprune_plugins.engines import slice_at
    from fragprune_plugins.finetuning import finetune
    from fragprune_plugins.injection.api import activate, deactivate, paused
    from fragprune_plugins.learning.schedule import Settings
    from fragprune_plugins.learning.thresholds import ThresholdStore
    from fragprune_plugins.plugins.hooks import rasterize
    from fragprune_plugins.types import (
        Footprints,
        Moment,
        RasterInputs,
        RasterOutputs,
        Sliced,
        SpacetimeSplats,
        Splats,
        View,
    )

__version__ = "0.1.0"

_HOME = {
    "Footprints": "types",
    "Moment": "types",
    "RasterInputs": "types",
    "RasterOutputs": "types",
    "Settings": "learning.schedule",
    "Sliced": "types",
    "SpacetimeSplats": "types",
    "Splats": "types",
    "ThresholdStore": "learning.thresholds",
    "View": "types",
    "activate": "injection.api",
    "deactivate": "injection.api",
    "finetune": "finetuning",
    "paused": "injection.api",
    "rasterize": "plugins.hooks",
    "slice_at": "engines",
}

__all__ = [
    "Footprints",
    "Moment",
    "RasterInputs",
    "RasterOutputs",
    "Settings",
    "Sliced",
    "SpacetimeSplats",
    "Splats",
    "ThresholdStore",
    "View",
    "__version__",
    "activate",
    "deactivate",
    "finetune",
    "paused",
    "rasterize",
    "slice_at",
]


def __getattr__(name: str) -> Any:
    if name not in _HOME:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    return getattr(import_module(f"{__name__}.{_HOME[name]}"), name)


def __dir__() -> list[str]:
    return sorted(__all__)
