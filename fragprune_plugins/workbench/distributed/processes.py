"""Several processes that hold a part of one model's Gaussians each.

They have the gradients of their own Gaussians, which the ``ShardedEngine`` brings to them, and tell
each other figures alone.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Any

import torch
from torch import Tensor

from fragprune_plugins.engines import Engine
from fragprune_plugins.errors import UsageError
from fragprune_plugins.files.model import Model
from fragprune_plugins.learning.schedule import Settings
from fragprune_plugins.learning.thresholds import ThresholdStore
from fragprune_plugins.workbench.distributed.sharded import ShardedEngine
from fragprune_plugins.workbench.finetune.processes import Processes
from fragprune_plugins.workbench.ranks import Ranks


class Shards(Processes):
    """Processes that each hold a part of the model's Gaussians.

    Args:
        count: of this process' Gaussians.
    """

    divided = True

    def __init__(self, ranks: Ranks, count: int) -> None:
        super().__init__(ranks)
        self.counts: list[int] = ranks.gather(count)

    def expect_able(self, settings: Settings) -> None:
        """Refuse views that cannot be divided, and an area that no process sees whole."""
        if settings.goal.on_area:
            raise UsageError(
                "finetune",
                "portable, and Gaussians divided among processes",
                "thresholds, or the whole model in each process",
                "Leave --portable or --shard-gaussians out.",
            )
        super().expect_able(settings)

    def _told(self, leaves: Sequence[Tensor]) -> list[Tensor]:
        """0, or NaN for a gradient that is not finite: as in a sum, it is everybody's then."""
        none = leaves[0].new_zeros(())
        return [none if each.grad is None else (0 * each.grad).sum() for each in leaves]

    def _gradient(self, leaf: Tensor, total: Tensor) -> Tensor:
        return total.expand_as(leaf).clone() if leaf.grad is None else leaf.grad + total

    def compare(self, tensors: Mapping[str, Tensor], step: int) -> None:
        """Do nothing: no two processes hold the same Gaussian."""

    def described(self, configuration: dict[str, Any]) -> dict[str, Any]:
        """As the processes have it, but for the digests of their parts, which are in a list."""
        parts = {name: self.ranks.gather(configuration[name]) for name in ("model", "thresholds")}
        return configuration | parts

    def total(self, count: int) -> int:
        """Gaussians of the whole model."""
        return sum(self.counts)

    def everywhere(self, rows: Tensor) -> Tensor:
        """The rows of all Gaussians, in each process."""
        size = self.ranks.size
        return self.ranks.exchange(
            rows.detach().repeat(size, *(1 for _ in rows.shape[1:])),
            [len(rows)] * size,
            self.counts,
        )

    def whole(self, rows: Tensor) -> Tensor:
        """The rows of all Gaussians in the main memory of the first process; elsewhere none."""
        none = [0] * (self.ranks.size - 1)
        by = self.counts if self.ranks.first else [0, *none]
        return self.ranks.exchange(rows.detach().cpu(), [len(rows), *none], by)

    def own(self, rows: Tensor) -> Tensor:
        """This process' rows, of those of all Gaussians."""
        start = sum(self.counts[: self.ranks.rank])
        return rows[start : start + self.counts[self.ranks.rank]]


def processes_of(engine: Engine, ranks: Ranks, count: int) -> Processes:
    """Shards if the engine is sharded, else copies; of ``count`` Gaussians in this process."""
    return Shards(ranks, count) if isinstance(engine, ShardedEngine) else Processes(ranks)


def part_of(model: Model, ranks: Ranks, device: torch.device | str) -> Model:
    """This process' share of a model's Gaussians, on a device: successive rows.

    Args:
        model: the same in all processes.
    """
    count = len(model)
    start, end = (count * rank // ranks.size for rank in (ranks.rank, ranks.rank + 1))
    rows = torch.arange(count, device=model.device)
    mask = (rows >= start) & (rows < end)
    return model.keep(mask).to(device)


def whole_of(model: Model, ranks: Ranks) -> Model:
    """The whole model, in the main memory of the first process, from everyone's part.

    Other processes get one without Gaussians.

    Raises:
        RanksError: another process is gone.
    """
    shards = Shards(ranks, len(model))
    rows: dict[str, Any] = {name: shards.whole(each) for name, each in model.tensors.items()}
    if any(ranks.gather(model.thresholds is not None)):
        store = model.thresholds or ThresholdStore(len(model), model.device)
        state = store.state_dict()
        parts = {k: shards.whole(each) for k, each in state.items() if isinstance(each, Tensor)}
        rows["thresholds"] = ThresholdStore(0)
        rows["thresholds"].load_state_dict(state | parts)
    return replace(model, **rows)
