"""fragprune: learned fragment pruning for every Gaussian-splatting codebase.

A picture of a splat, truncated by its thresholds::

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
    from fragprune_plugins.files.model import Model
    from fragprune_plugins.injection.api import activate, deactivate, paused
    from fragprune_plugins.learning.goals import Control, Fewer, Portable, Pressure
    from fragprune_plugins.learning.schedule import Schedule, Settings, StepPlan
    from fragprune_plugins.learning.thresholds import ThresholdStore
    from fragprune_plugins.plugins.hooks import engine_for
    from fragprune_plugins.types import Footprints, RasterInputs, RasterOutputs, Splats, View
    from fragprune_plugins.workbench.distributed.processes import part_of, whole_of
    from fragprune_plugins.workbench.distributed.sharded import ShardedEngine
    from fragprune_plugins.workbench.figures.drawing import rasterize
    from fragprune_plugins.workbench.figures.evaluate import measure
    from fragprune_plugins.workbench.figures.viewing import overview, render_view
    from fragprune_plugins.workbench.finetune.api import finetune
    from fragprune_plugins.workbench.finetune.result import FinetuneResult
    from fragprune_plugins.workbench.goals import AtMost, Faster
    from fragprune_plugins.workbench.models.model import load, save
    from fragprune_plugins.workbench.pruning.scores import keep_best, keep_needed
    from fragprune_plugins.workbench.ranks import joined
    from fragprune_plugins.workbench.scenes.cameras import load_cameras
    from fragprune_plugins.workbench.scenes.dataset import load_dataset
    from fragprune_plugins.workbench.scenes.generated import views_near
    from fragprune_plugins.workbench.scenes.itself import own_pictures
    from fragprune_plugins.workbench.scenes.pinhole import look_at

__version__ = VERSION

_NAMES = {
    "files.model": "Model",
    "injection.api": "activate deactivate paused",
    "learning.goals": "Control Fewer Portable Pressure",
    "learning.schedule": "Schedule Settings StepPlan",
    "learning.thresholds": "ThresholdStore",
    "plugins.hooks": "engine_for",
    "types": "Footprints RasterInputs RasterOutputs Splats View",
    "workbench.distributed.processes": "part_of whole_of",
    "workbench.distributed.sharded": "ShardedEngine",
    "workbench.figures.drawing": "rasterize",
    "workbench.figures.evaluate": "measure",
    "workbench.figures.viewing": "overview render_view",
    "workbench.finetune.api": "finetune",
    "workbench.finetune.result": "FinetuneResult",
    "workbench.goals": "AtMost Faster",
    "workbench.models.model": "load save",
    "workbench.pruning.scores": "keep_best keep_needed",
    "workbench.ranks": "joined",
    "workbench.scenes.cameras": "load_cameras",
    "workbench.scenes.dataset": "load_dataset",
    "workbench.scenes.generated": "views_near",
    "workbench.scenes.itself": "own_pictures",
    "workbench.scenes.pinhole": "look_at",
}
"""By module, the names that it gives this package."""

_HOME = {name: module for module, names in _NAMES.items() for name in names.split()}

__all__ = [
    "AtMost",
    "Control",
    "Faster",
    "Fewer",
    "FinetuneResult",
    "Footprints",
    "Model",
    "Portable",
    "Pressure",
    "RasterInputs",
    "RasterOutputs",
    "Schedule",
    "Settings",
    "ShardedEngine",
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
    "look_at",
    "measure",
    "overview",
    "own_pictures",
    "part_of",
    "paused",
    "rasterize",
    "render_view",
    "save",
    "views_near",
    "whole_of",
]


def __getattr__(name: str) -> Any:
    if name not in _HOME:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    return getattr(import_module(f"{__name__}.{_HOME[name]}"), name)


def __dir__() -> list[str]:
    return sorted(__all__)
