"""Settings of stage 2 as nerfstudio's flags have them: plain values, the goal as text."""

from __future__ import annotations

from dataclasses import dataclass, fields
from typing import Literal

from fragprune_plugins import Settings
from fragprune_plugins.adapting import parse_goal


@dataclass
class Learning:
    """``Settings`` of a training; nerfstudio has a seed, and views in a step, of its own."""

    iterations: int = Settings.iterations
    """Steps of stage 2."""
    train: Literal["opacity", "appearance", "all"] = Settings.train
    """What moves beside the thresholds."""
    goal: str = str(Settings.goal)
    """pressure, pressure=X, fewer=X, portable, portable=X or control."""
    threshold_lr: float = Settings.threshold_lr
    """Initial learning rate of threshold logits."""
    opacity_lr: float = Settings.opacity_lr
    """Initial learning rate of opacity logits."""
    stop: float | Literal["auto"] | None = Settings.stop
    """Share of a pixel's light at which it stops; auto is the usual one, None adds none."""
    rim: Literal["hard", "soft"] | None = None
    """How thresholds cut; None keeps what the model has."""

    def settings(self) -> Settings:
        """The settings of these flags; raises UsageError if one is out of range."""
        given = {each.name: getattr(self, each.name) for each in fields(self)}
        return Settings(**given | {"goal": parse_goal(self.goal)})


def flags_of(settings: Settings) -> dict[str, str]:
    """By name, as flags spell it, what differs from the defaults."""
    default, given = Settings().as_dict(), settings.as_dict()
    return {
        each.name.replace("_", "-"): str(given[each.name])
        for each in fields(Learning)
        if given[each.name] != default[each.name]
    }
