"""Stage 2 in several processes, each of which draws some of a step's views."""

from __future__ import annotations

from collections.abc import Callable, Hashable, Sequence

from torch import Tensor

from fragprune_plugins.learning.pressure import StepViews
from fragprune_plugins.learning.schedule import StepPlan
from fragprune_plugins.learning.stage2 import Stage2


class SharedStage(Stage2):
    """Learning of thresholds whose views several processes draw, as if one had drawn them all."""

    _visited = (0, 0)  # how many pictures were known before this step

    def begin(self, opacities: Callable[[], Tensor]) -> StepPlan:
        """A step begins; see ``Stage2``."""
        self._visited = len(self._before), len(self._after)
        return super().begin(opacities)

    def figures(self) -> list[list[float]]:
        """Of each view drawn in this step that counts, for ``share``.

        Fragments per pixel now and before, what the pressure acts on, and the loss.
        """
        return self._views.rows()

    def share(self, views: Sequence[Hashable], figures: Tensor) -> None:
        """This step's views were drawn by several processes: take over the figures of all.

        Args:
            views: all of this step, in the same order in every process.
            figures: (V, 4), the rows that ``figures`` gave in the processes that drew them.
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
