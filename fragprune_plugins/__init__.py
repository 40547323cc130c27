"""fragprune: learned fragment pruning for every Gaussian-splatting codebase.

A picture of a splat, truncated by the thresholds beside it::

    import fragprune_plugins as fp
    model = fp.load("model.ply")
    fp.render_view(model).save("view.png")

Importing this package imports neither torch nor any host; names load when they are first used.
"""

from __future__ import annotations

from importlib import import_module
from typing import TYPE_CHECKING, Any

from fragprune_plugins.constants import VERSION

if TYPE_CHECKING:
    from fragprune_plugins.bench.calibration import prices_of
    from fragprune_plugins.datasets.cameras import load_cameras
    from fragprune_plugins.datasets.dataset import load_dataset
    from fragprune_plugins.engines import slice_at
    from fragprune_plugins.engines.cost import Cost
    from fragprune_plugins.engines.sharded import ShardedEngine
    from fragprune_plugins.finetuning import FinetuneResult, finetune, own_pictures
    from fragprune_plugins.finetuning.processes import part_of, whole_of
    from fragprune_plugins.injection.api import activate, deactivate, paused
    from fragprune_plugins.learning.ranks import joined
    from fragprune_plugins.learning.schedule import Schedule, Settings, StepPlan
    from fragprune_plugins.learning.thresholds import ThresholdStore
    from fragprune_plugins.measure.scores import keep_best, keep_needed
    from fragprune_plugins.measure.viewing import overview, render_view
    from fragprune_plugins.plugins.hooks import engine_for, rasterize
    from fragprune_plugins.storage.models import Model, load, save
    from fragprune_plugins.storage.ply import SplatFile
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

__version__ = VERSION

_HOME = {
    "Cost": "engines.cost",
    "FinetuneResult": "finetuning",
    "Footprints": "types",
    "Model": "storage.models",
    "Moment": "types",
    "RasterInputs": "types",
    "RasterOutputs": "types",
    "Schedule": "learning.schedule",
    "Settings": "learning.schedule",
    "ShardedEngine": "engines.sharded",
    "Sliced": "types",
    "SpacetimeSplats": "types",
    "SplatFile": "storage.ply",
    "Splats": "types",
    "StepPlan": "learning.schedule",
    "ThresholdStore": "learning.thresholds",
    "View": "types",
    "activate": "injection.api",
    "deactivate": "injection.api",
    "engine_for": "plugins.hooks",
    "finetune": "finetuning",
    "joined": "learning.ranks",
    "keep_best": "measure.scores",
    "keep_needed": "measure.scores",
    "load": "storage.models",
    "load_cameras": "datasets.cameras",
    "load_dataset": "datasets.dataset",
    "overview": "measure.viewing",
    "own_pictures": "finetuning",
    "part_of": "finetuning.processes",
    "prices_of": "bench.calibration",
    "paused": "injection.api",
    "rasterize": "plugins.hooks",
    "render_view": "measure.viewing",
    "save": "storage.models",
    "slice_at": "engines",
    "whole_of": "finetuning.processes",
}

__all__ = [
    "Cost",
    "FinetuneResult",
    "Footprints",
    "Model",
    "Moment",
    "RasterInputs",
    "RasterOutputs",
    "Schedule",
    "Settings",
    "ShardedEngine",
    "Sliced",
    "SpacetimeSplats",
    "SplatFile",
    "Splats",
    "StepPlan",
    "ThresholdStore",
    "View",
    "__version__",
    "activate",
    "deactivate",
    "engine_for",
    "finetune",
    "joined",
    "keep_best",
    "keep_needed",
    "load",
    "load_cameras",
    "load_dataset",
    "overview",
    "own_pictures",
    "part_of",
    "paused",
    "prices_of",
    "rasterize",
    "render_view",
    "save",
    "slice_at",
    "whole_of",
]


def __getattr__(name: str) -> Any:
    if name not in _HOME:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    return getattr(import_module(f"{__name__}.{_HOME[name]}"), name)


def __dir__() -> list[str]:
    return sorted(__all__)
