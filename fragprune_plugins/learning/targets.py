"""A ratio that thresholds are held to, before over after, and the shift that meets it.

This one is of fragments; one of what follows them, such as the time of a frame, overrides it.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import TYPE_CHECKING, Any, ClassVar

from fragprune_plugins.learning.plain import put

if TYPE_CHECKING:
    from fragprune_plugins.learning.thresholds import ThresholdStore

TOLERANCE = 0.05  # a target counts as reached within this relative distance
FEWEST = 20  # no target makes fragments fewer than this many times
CALIBRATE_AT = 0.85  # share of the learning after which a shift meets the target, and they stay
CALIBRATION_VIEWS = 24  # number of training views that a calibration measures at most
_REACH = 8.0  # largest shift either way, in logits


class Target:
    """Meets a ratio of fragments, untruncated over truncated."""

    figure: ClassVar[str] = "speedup"  # under which the ratio that was met is reported

    def __init__(self, ratio: float) -> None:
        self.ratio = ratio
        self.met: float | None = None

    def followed(self, fragments: float) -> float:
        """The figure's ratio that a ratio of fragments brings, to steer by."""
        return fragments

    def look(self, progress: float, ratio: Callable[[], float], views: Sequence[Any]) -> None:
        """Measure by the way, before any step until ``meet``; ``ratio`` and ``views`` as there."""

    def meet(self, store: ThresholdStore, ratio: Callable[[], float], views: Sequence[Any]) -> None:
        """Shift all thresholds onto the target; ``ratio`` draws the views and gives theirs."""
        self.met = calibrate(store, ratio, self.ratio)

    def state(self) -> dict[str, Any]:
        """Plain values, for ``load_state``."""
        return {"met": self.met}

    def load_state(self, state: Mapping[str, Any]) -> None:
        """Take over what ``state`` gave; raises ValueError for anything else."""
        put(self, {name: state[name] for name in self.state()})


def calibrate(
    store: ThresholdStore,
    ratio: Callable[[], float],
    target: float,
    *,
    tolerance: float = 0.01,
    rounds: int = 16,
) -> float:
    """Shift all threshold logits by one number so that ``ratio()`` meets ``target``.

    The ratio grows with the shift, so bisection finds it. Where the target lies out of reach the
    nearest end is kept. Call it late in the run and let opacities adapt afterwards.

    Args:
        ratio: before over after, with the store as it stands.
        tolerance: relative distance at which to stop.
        rounds: most measurements.

    Returns:
        The ratio measured last.
    """
    start = store.logits.detach().clone()
    low, high = -_REACH, _REACH
    shift, reached = 0.0, ratio()
    for _ in range(rounds):
        if abs(reached / target - 1) <= tolerance:
            break
        if reached < target:
            low = shift
        else:
            high = shift
        shift = (low + high) / 2
        store.place(start + shift)
        reached = ratio()
    return reached
