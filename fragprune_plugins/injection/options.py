"""What a run is asked for, and what came of it."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Literal

from torch import Tensor

from fragprune_plugins.errors import NotComparedError
from fragprune_plugins.hosts.photographs import Photographs
from fragprune_plugins.learning.events import Summary
from fragprune_plugins.learning.schedule import Settings

Stage = Literal["auto", "finetune", "joint", "off"]

Look = Callable[[Path, Photographs, Mapping[str, Any], Settings], tuple[Settings, Tensor | None]]
"""Is given the PLY of stage 1, its photographs, fields of ``RasterInputs`` with which the host
draws it, and the settings that were asked for.

It gives those to learn with, and (N,) bool, the Gaussians that stage 2 begins with; None for all.
"""


@dataclass(frozen=True)
class RunOptions:
    """Options of a run.

    Attributes:
        adapter: the adapter's name, or None to detect it from the host's source.
        stage: "auto" trains and then fine-tunes. "finetune" resumes from a model in the output
            folder, or from the file that the host's resume flag names. "joint" learns inside the
            host's training. "off" only applies thresholds of sidecars and checkpoints.
        settings: settings of the fine-tuning.
        from_iter: iteration after which learning begins inside one run. "finetune" also freezes the
            model from there on. None: "joint" learns once the host's densification is over.
        engine: "auto", "reference", "cpu", "cuda", or the name of a plugin's engine.
        device: the host's device. "cpu" runs a CUDA-only host without a GPU, "cuda" and "cuda:N"
            require a GPU, "auto" takes a GPU if torch sees one.
        again: False leaves finished stages alone. If the stage 2 that "finetune" asks for has its
            result already, nothing runs. If an earlier run of the same command finished stage 1
            and not stage 2, "auto" begins with stage 2.
        trust: go on where the host's own rasterizer draws otherwise than our engine.
        look: is called before stage 2 of a model whose PLY alone shows what the host draws; None
            learns as asked.
    """

    adapter: str | None = None
    stage: Stage = "auto"
    settings: Settings = field(default_factory=Settings)
    from_iter: int | None = None
    engine: str = "auto"
    device: str = "auto"
    again: bool = True
    trust: bool = False
    look: Look | None = None


@dataclass(frozen=True, kw_only=True)
class RunSummary(Summary):
    """The result of a run; without a step where nothing learned."""

    device: str
    stage: str
    model_before: Path | None = None  # the host's PLY of stage 1, if there is one
    model_after: Path | None = None  # that after stage 2; its sidecar lies beside it
    train_seconds: float
    curves: list[dict[str, float]]  # ``StepStats`` of each learned step
    output: Path | None = None  # the host's folder; stage 1's, if stage 2 has its own
    photographs: Photographs | None = None  # whose held-out views, if any, measure the models
    drawing: dict[str, Any] = field(default_factory=dict)  # fields of the host's ``RasterInputs``
    not_compared: NotComparedError | None = None  # the reason, if learned models cannot be
    already_finished: bool = False  # ``model_after`` was there before, and nothing was run
