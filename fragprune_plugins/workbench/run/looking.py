"""Looks at the model of stage 1 before stage 2: whether it knows its photographs by heart."""

from __future__ import annotations

import logging
from dataclasses import dataclass
from pathlib import Path

from torch import Tensor

from fragprune_plugins.errors import FragpruneError
from fragprune_plugins.hosts.photographs import Photographs
from fragprune_plugins.learning.schedule import Settings
from fragprune_plugins.workbench.commands.opening import open_engine
from fragprune_plugins.workbench.commands.options import EngineOptions
from fragprune_plugins.workbench.finetune.trial import Trial, tried
from fragprune_plugins.workbench.models.model import load
from fragprune_plugins.workbench.pruning.scores import best, removal_error
from fragprune_plugins.workbench.scenes.dataset import load_photographs
from fragprune_plugins.workbench.scenes.generated import views_near

log = logging.getLogger("fragprune")


@dataclass
class Looking:
    """What ``RunOptions.look`` calls.

    Attributes:
        engine: draws.
        trial: what was found; None before, and where nothing could be tried.
    """

    engine: EngineOptions
    trial: Trial | None = None

    def __call__(
        self, ply: Path, photographs: Photographs, settings: Settings
    ) -> tuple[Settings, Tensor | None]:
        """Make the trial of ``fragprune finetune``, and score the Gaussians as it does."""
        try:
            return self._look(ply, photographs, settings)
        except FragpruneError as error:  # the host may read and draw more than we do
            log.warning("not tried whether it knows its photographs by heart, because of %s", error)
            return settings, None

    def _look(
        self, ply: Path, photographs: Photographs, settings: Settings
    ) -> tuple[Settings, Tensor | None]:
        engine, device = open_engine(self.engine)
        model, dataset = load(ply, device=device), load_photographs(photographs).to(device)
        trial, kept = tried(model, dataset, settings, engine=engine, say=log.info), None
        if isinstance(trial.keep, float):
            views = views_near(dataset.train, seed=settings.seed)
            kept = best(removal_error(model, model.falloff, views, engine), trial.keep).cpu()
        self.trial = trial
        return trial.settings, kept
