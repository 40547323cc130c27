"""What the processes of a fine-tuning do between them; one process alone does nothing."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

from torch import Tensor

if TYPE_CHECKING:
    from fragprune_plugins.learning.interruption import Waiting
    from fragprune_plugins.learning.schedule import Settings
    from fragprune_plugins.workbench.finetune.loop import Training
    from fragprune_plugins.workbench.scenes.dataset import Shot


class Alone:
    """One process, which holds the whole model.

    A training asks it in every step. Several processes (``workbench.processes``) override what they
    do otherwise.

    Attributes:
        first: this process writes files and speaks.
        several: there are others.
        divided: other processes hold other Gaussians of the model.
        may_end: a signal may end the training after this step.
    """

    first = True
    several = False
    divided = False
    may_end = True

    def expect_able(self, settings: Settings) -> None:
        """Raise UsageError if these processes cannot share the work of settings."""

    def agree(self, known: dict[str, Any]) -> None:
        """Raise RanksError if another process is about to learn something else."""

    def share(self, shots: Sequence[Shot]) -> Sequence[Shot]:
        """The views of a step that this process draws."""
        return shots

    def went_backward(self, training: Training, shots: Sequence[Shot], waiting: Waiting) -> None:
        """The gradients of a step are there; raises RanksError if another process is gone."""

    def stepped(self, training: Training) -> None:
        """A step is over; raises RanksError if processes have parted."""

    def finished(self, training: Training) -> None:
        """The last step is over; raises RanksError if processes have parted."""

    def keeps(self, training: Training) -> bool:
        """Whether it is time for a checkpoint after this step."""
        return training.keeper is not None and training.keeper.due(training.done)

    def described(self, configuration: dict[str, Any]) -> dict[str, Any]:
        """What decides the result, in the words of all processes together."""
        return configuration

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
