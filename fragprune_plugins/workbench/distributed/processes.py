"""How several processes learn one model: each holds a copy of it, or each a part.

Replicas sum their gradients, and stay equal to the bit. Shards have the gradients of their own
Gaussians, which the ``ShardedEngine`` brings to them, and tell each other figures alone.
"""

from __future__ import annotations

import signal
from collections.abc import Mapping, Sequence
from dataclasses import replace
from itertools import accumulate
from typing import Any

import torch
from torch import Tensor

from fragprune_plugins.engines import Engine
from fragprune_plugins.errors import UsageError
from fragprune_plugins.files.model import Model
from fragprune_plugins.learning.schedule import Settings
from fragprune_plugins.learning.thresholds import ThresholdStore
from fragprune_plugins.learning.waiting import Waiting
from fragprune_plugins.workbench.distributed.sharded import ShardedEngine
from fragprune_plugins.workbench.distributed.stage import SharedStage
from fragprune_plugins.workbench.finetune.loop import Alone, Training
from fragprune_plugins.workbench.goals import Faster
from fragprune_plugins.workbench.ranks import Ranks, fingerprint
from fragprune_plugins.workbench.scenes.dataset import Shot

_SIGNALS = (signal.SIGINT, signal.SIGTERM)
_COMPARE = 100  # steps from one comparison of replicas to the next


class Replicas(Alone):
    """Processes that each hold the whole model."""

    stage = SharedStage

    def __init__(self, ranks: Ranks) -> None:
        self.ranks, self.first, self.several = ranks, ranks.first, ranks.several
        self._due = False  # it is time for a checkpoint, some process says

    def expect_able(self, settings: Settings) -> None:
        """Refuse views that cannot be divided, and times, which others would disturb."""
        if self.several and isinstance(settings.goal, Faster):
            raise UsageError(
                "target time",
                f"{self.ranks.size} processes, which would disturb each other's measurements",
                "one process",
                "Aim for fewer fragments, or start one process.",
            )
        if settings.views_per_step % self.ranks.size:
            raise UsageError(
                "views per step",
                f"{settings.views_per_step} for {self.ranks.size} processes",
                f"a multiple of {self.ranks.size}",
                "Change --views-per-step.",
            )

    def agree(self, known: dict[str, Any]) -> None:
        """See whether all were asked for the same."""
        self.ranks.agree(known, "fine-tuning, before its first step")

    def share(self, shots: Sequence[Shot]) -> Sequence[Shot]:
        """Every so-manieth view."""
        return self.ranks.share(shots)

    @torch.no_grad()
    def went_backward(self, training: Training, shots: Sequence[Shot], waiting: Waiting) -> None:
        """Take over from all processes gradients and figures; and whether to end, or to keep."""
        if not self.several:
            return
        stage, keeper = training.stage, training.keeper
        assert isinstance(stage, SharedStage)
        leaves = [*training.parameters().values(), stage.store.logits]
        due = keeper is not None and keeper.due(training.done + 1)
        flags = [*(waiting.number == number for number in _SIGNALS), due]
        rows = stage.figures()
        table, (*signals, self._due) = self.exchange(leaves, rows, len(shots), flags)
        if rows:
            stage.share(shots, table)
        came = [number for number, some in zip(_SIGNALS, signals, strict=True) if some]
        self.may_end = bool(came)  # one that comes later waits for the next exchange
        if came and not waiting.number:
            signal.raise_signal(came[0])  # it came to another process: all end after this step

    def stepped(self, training: Training) -> None:
        """Compare all that learns, from time to time."""
        if training.done % _COMPARE == 0:
            self.finished(training)

    def finished(self, training: Training) -> None:
        """Compare all that learns."""
        if self.several:
            learned = training.parameters() | {"thresholds": training.stage.store.logits}
            self.compare(learned, training.done)

    def keeps(self, training: Training) -> bool:
        """As all decided in the step."""
        return self._due if self.several else super().keeps(training)

    def exchange(
        self,
        leaves: Sequence[Tensor],
        rows: Sequence[Sequence[float]],
        views: int,
        flags: Sequence[bool],
    ) -> tuple[Tensor, list[bool]]:
        """Make gradients those of all views of a step; tell each process all figures.

        It is one reduction of one tensor.

        Args:
            leaves: the tensors that learn. Their gradients are changed in place, and are there
                afterwards if any process has one.
            rows: four figures of each view that this process drew.
            views: how many all processes drew.
            flags: what this process noticed.

        Returns:
            (views, 4) figures of all views; and of each flag, whether any process has it.

        Raises:
            RanksError: another process is gone.
        """
        table = leaves[0].new_zeros(views, 4)
        if rows:
            table[self.ranks.rank :: self.ranks.size] = table.new_tensor(rows)
        noticed = table.new_tensor(flags)
        there = table.new_tensor([leaf.grad is not None for leaf in leaves])
        told = self._told(leaves)
        *sums, there, noticed, table = self._summed([*told, there, noticed, table])
        for leaf, total, some in zip(leaves, sums, there.tolist(), strict=True):
            leaf.grad = self._gradient(leaf, total) if some else None
        return table, [some > 0 for some in noticed.tolist()]

    def _told(self, leaves: Sequence[Tensor]) -> list[Tensor]:
        """What the others are told of each leaf's gradient."""
        return [torch.zeros_like(each) if each.grad is None else each.grad for each in leaves]

    def _gradient(self, leaf: Tensor, total: Tensor) -> Tensor:
        """A leaf's gradient, from what all processes told together."""
        return total

    def _summed(self, parts: Sequence[Tensor]) -> list[Tensor]:
        flat = torch.cat([part.reshape(-1) for part in parts])
        self.ranks.sum(flat)
        ends = accumulate(part.numel() for part in parts)
        return [
            flat[end - part.numel() : end].view_as(part)
            for end, part in zip(ends, parts, strict=True)
        ]

    def compare(self, tensors: Mapping[str, Tensor], step: int) -> None:
        """Stop unless all processes hold the same bits.

        Raises:
            RanksError: they differ.
        """
        known = {name: fingerprint(tensor) for name, tensor in tensors.items()}
        self.ranks.agree(known, f"fine-tuning, after step {step}")


class Shards(Replicas):
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


def processes_of(engine: Engine, ranks: Ranks, count: int) -> Alone:
    """Replicas, or shards if the engine is sharded; of ``count`` Gaussians in this process."""
    if isinstance(engine, ShardedEngine):
        return Shards(ranks, count)
    return Replicas(ranks) if ranks.several else Alone()


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
