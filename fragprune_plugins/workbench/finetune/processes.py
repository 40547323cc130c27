"""How processes learn one model: one alone, or several that each hold a copy of it.

Copies sum their gradients, and stay equal to the bit. ``workbench.distributed`` divides a model.
"""

from __future__ import annotations

import signal
from collections.abc import Callable, Hashable, Mapping, Sequence

import torch
from torch import Tensor

from fragprune_plugins.errors import UsageError
from fragprune_plugins.learning.deferred import DeferredSignals
from fragprune_plugins.learning.pressure import StepViews
from fragprune_plugins.learning.schedule import Settings, StepPlan
from fragprune_plugins.learning.stage2 import Stage2
from fragprune_plugins.workbench.goals import Faster
from fragprune_plugins.workbench.ranks import Ranks, fingerprint
from fragprune_plugins.workbench.scenes.dataset import Shot

_SIGNALS = (signal.SIGINT, signal.SIGTERM)
_COMPARE = 100  # steps from one comparison of copies to the next


class SharedStage(Stage2):
    """Learning of thresholds whose views several processes draw, as if one had drawn them all."""

    _visited = (0, 0)  # how many pictures were known before this step

    def begin(self, opacities: Callable[[], Tensor]) -> StepPlan:
        """Note what is known before a step; see ``Stage2``."""
        self._visited = len(self._before), len(self._after)
        return super().begin(opacities)

    def figures(self) -> list[list[float]]:
        """Of each view drawn in this step that counts, four figures for ``share``."""
        return self._views.rows()

    def share(self, views: Sequence[Hashable], figures: Tensor) -> None:
        """This step's views, in the same order in every process, were drawn by several.

        The rows of figures (V, 4) are those that ``figures`` gave in the processes that drew them:
        fragments per pixel now and before, what the pressure acts on, and the loss.
        """
        for known, count in zip((self._before, self._after), self._visited, strict=True):
            for picture in list(known)[count:]:  # the order of what is new must be the same
                del known[picture]
        self._views = StepViews(self._views.expected)
        for view, (drawn, before, pressed, loss) in zip(views, figures, strict=True):
            picture = view, 0
            self._before.setdefault(picture, before.reshape(1))
            if self._open:
                self._after[picture] = drawn.reshape(1)
            self._views.draw(drawn, before, pressed)
            self._views.lose(loss)


class Processes:
    """Processes that each hold the whole model; one alone is the usual case.

    Attributes:
        first: this process writes files and speaks.
        divided: other processes hold other Gaussians of the model.
        may_end: a signal may end the training after this step.
        due: it is time for a checkpoint after this step, some process says.
    """

    divided = False
    may_end = True

    def __init__(self, ranks: Ranks) -> None:
        self.ranks, self.first = ranks, ranks.first
        self.due = False

    def expect_able(self, settings: Settings) -> None:
        """Refuse views that cannot be divided, and times, which others would disturb."""
        if self.ranks.several and isinstance(settings.goal, Faster):
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

    @torch.no_grad()
    def went_backward(
        self,
        stage: SharedStage,
        learned: Mapping[str, Tensor],
        shots: Sequence[Shot],
        waiting: DeferredSignals,
        *,
        due: bool,
    ) -> None:
        """Take over from all processes gradients and figures; and whether to end, or to keep.

        ``due`` says that it is time for a checkpoint after this step, by this process.
        """
        self.due = due
        if not self.ranks.several:
            return
        flags = [*(waiting.number == number for number in _SIGNALS), due]
        rows, leaves = stage.figures(), [*learned.values()]
        table, (*signals, self.due) = self.exchange(leaves, rows, len(shots), flags)
        if rows:
            stage.share(shots, table)
        came = [number for number, some in zip(_SIGNALS, signals, strict=True) if some]
        self.may_end = bool(came)  # one that comes later waits for the next exchange
        if came and not waiting.number:
            signal.raise_signal(came[0])  # it came to another process: all end after this step

    def stepped(self, learned: Mapping[str, Tensor], step: int, *, last: bool = False) -> None:
        """Compare all that learns, from time to time; raises RanksError if processes differ."""
        if self.ranks.several and (last or step % _COMPARE == 0):
            known = {name: fingerprint(tensor) for name, tensor in learned.items()}
            self.ranks.agree(known, f"fine-tuning, after step {step}")

    def total(self, count: int) -> int:
        """Gaussians of the whole model, from those that this process holds."""
        return count

    def everywhere(self, rows: Tensor) -> Tensor:
        """The rows of all Gaussians, in each process."""
        return rows

    def whole(self, rows: Tensor) -> Tensor:
        """The rows of all Gaussians, in the first process; there may be none in others."""
        return rows

    def own(self, rows: Tensor) -> Tensor:
        """This process' rows, of those of all Gaussians."""
        return rows

    def exchange(
        self,
        leaves: Sequence[Tensor],
        rows: Sequence[Sequence[float]],
        views: int,
        flags: Sequence[bool],
    ) -> tuple[Tensor, list[bool]]:
        """Make gradients of leaves those of all views of a step, by one reduction of one tensor.

        A leaf has a gradient afterwards if it has one in any process.

        Args:
            rows: four figures of each view that this process drew, of ``views`` in all.
            flags: what this process noticed.

        Returns:
            (views, 4) figures of all views; and of each flag, whether any process has it.
        """
        table = leaves[0].new_zeros(views, 4)
        if rows:
            table[self.ranks.rank :: self.ranks.size] = table.new_tensor(rows)
        noticed = table.new_tensor(flags)
        there = table.new_tensor([leaf.grad is not None for leaf in leaves])
        parts = [*self._told(leaves), there, noticed, table]
        flat = torch.cat([part.reshape(-1) for part in parts])
        self.ranks.sum(flat)
        pieces = flat.split_with_sizes([part.numel() for part in parts])
        *sums, there, noticed, table = map(torch.Tensor.view_as, pieces, parts)
        for leaf, total, some in zip(leaves, sums, there.tolist(), strict=True):
            leaf.grad = self._gradient(leaf, total) if some else None
        return table, [some > 0 for some in noticed.tolist()]

    def _told(self, leaves: Sequence[Tensor]) -> list[Tensor]:
        """What the others are told of each leaf's gradient."""
        return [torch.zeros_like(each) if each.grad is None else each.grad for each in leaves]

    def _gradient(self, leaf: Tensor, total: Tensor) -> Tensor:
        """A leaf's gradient, from what all processes told together."""
        return total
