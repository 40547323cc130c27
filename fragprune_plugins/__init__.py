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
    from fragprune_plugins.files.model import Model as Model
    from fragprune_plugins.injection.api import activate as activate
    from fragprune_plugins.injection.api import deactivate as deactivate
    from fragprune_plugins.injection.api import paused as paused
    from fragprune_plugins.learning.goals import Control as Control
    from fragprune_plugins.learning.goals import Fewer as Fewer
    from fragprune_plugins.learning.goals import Portable as Portable
    from fragprune_plugins.learning.goals import Pressure as Pressure
    from fragprune_plugins.learning.schedule import Schedule as Schedule
    from fragprune_plugins.learning.schedule import Settings as Settings
    from fragprune_plugins.learning.schedule import StepPlan as StepPlan
    from fragprune_plugins.learning.thresholds import ThresholdStore as ThresholdStore
    from fragprune_plugins.plugins.hooks import engine_for as engine_for
    from fragprune_plugins.types import Footprints as Footprints
    from fragprune_plugins.types import RasterInputs as RasterInputs
    from fragprune_plugins.types import RasterOutputs as RasterOutputs
    from fragprune_plugins.types import Splats as Splats
    from fragprune_plugins.types import View as View
    from fragprune_plugins.workbench.distributed import ShardedEngine as ShardedEngine
    from fragprune_plugins.workbench.distributed import part_of as part_of
    from fragprune_plugins.workbench.distributed import whole_of as whole_of
    from fragprune_plugins.workbench.figures.evaluate import measure as measure
    from fragprune_plugins.workbench.figures.viewing import overview as overview
    from fragprune_plugins.workbench.figures.viewing import rasterize as rasterize
    from fragprune_plugins.workbench.figures.viewing import render_view as render_view
    from fragprune_plugins.workbench.finetune.api import finetune as finetune
    from fragprune_plugins.workbench.finetune.loop import FinetuneResult as FinetuneResult
    from fragprune_plugins.workbench.finetune.relocation import spare as spare
    from fragprune_plugins.workbench.goals import AtMost as AtMost
    from fragprune_plugins.workbench.goals import Faster as Faster
    from fragprune_plugins.workbench.models.model import load as load
    from fragprune_plugins.workbench.models.model import save as save
    from fragprune_plugins.workbench.pruning import keep_best as keep_best
    from fragprune_plugins.workbench.pruning import keep_needed as keep_needed
    from fragprune_plugins.workbench.ranks import joined as joined
    from fragprune_plugins.workbench.scenes.cameras import load_cameras as load_cameras
    from fragprune_plugins.workbench.scenes.dataset import load_dataset as load_dataset
    from fragprune_plugins.workbench.scenes.generated import own_pictures as own_pictures
    from fragprune_plugins.workbench.scenes.generated import views_near as views_near
    from fragprune_plugins.workbench.scenes.pinhole import look_at as look_at

__version__ = VERSION

_NAMES = {
    "files.model": "Model",
    "injection.api": "activate deactivate paused",
    "learning.goals": "Control Fewer Portable Pressure",
    "learning.schedule": "Schedule Settings StepPlan",
    "learning.thresholds": "ThresholdStore",
    "plugins.hooks": "engine_for",
    "types": "Footprints RasterInputs RasterOutputs Splats View",
    "workbench.distributed": "ShardedEngine part_of whole_of",
    "workbench.figures.evaluate": "measure",
    "workbench.figures.viewing": "overview rasterize render_view",
    "workbench.finetune.api": "finetune",
    "workbench.finetune.loop": "FinetuneResult",
    "workbench.finetune.relocation": "spare",
    "workbench.goals": "AtMost Faster",
    "workbench.models.model": "load save",
    "workbench.pruning": "keep_best keep_needed",
    "workbench.ranks": "joined",
    "workbench.scenes.cameras": "load_cameras",
    "workbench.scenes.dataset": "load_dataset",
    "workbench.scenes.generated": "own_pictures views_near",
    "workbench.scenes.pinhole": "look_at",
}
"""By module, the names that it gives this package."""

_HOME = {name: module for module, names in _NAMES.items() for name in names.split()}

__all__ = sorted(["__version__", *_HOME])


def __getattr__(name: str) -> Any:
    if name not in _HOME:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    return getattr(import_module(f"{__name__}.{_HOME[name]}"), name)


def __dir__() -> list[str]:
    return __all__
