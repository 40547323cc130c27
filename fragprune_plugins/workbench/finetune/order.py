"""The order of views: permutations of all of them, one after the other."""

from __future__ import annotations

import random
from collections.abc import Iterator, Sequence
from typing import TypeVar

View = TypeVar("View")


def order(
    views: Sequence[View], steps: int, views_per_step: int, seed: int
) -> Iterator[Sequence[View]]:
    """For each step its views; the global random streams are not touched."""
    stream = random.Random(seed)
    queue: list[View] = []
    for _ in range(steps):
        chosen: list[View] = []
        for _ in range(views_per_step):
            if not queue:
                queue = list(views)
                stream.shuffle(queue)
            chosen.append(queue.pop())
        yield chosen
