"""Let Ctrl-C and SIGTERM wait for the end of a step, so that what is kept is a whole state."""

from __future__ import annotations

import contextlib
import os
import signal
import threading
from collections.abc import Callable, Iterator
from types import FrameType


class DeferredSignals:
    """Signals that wait for the end of a step. Called, it lets the last of them act."""

    def __init__(self, handlers: dict[int, Callable[[int, FrameType | None], object]]) -> None:
        self._handlers, self._process = handlers, os.getpid()
        self._came: list[tuple[int, FrameType | None]] = []

    @property
    def number(self) -> int:
        """Of the signal that waits; 0 if none does."""
        return self._came[-1][0] if self._came else 0

    def __call__(self) -> None:
        """Let the signal act that waits, if any does."""
        if self._came:
            number, frame = self._came.pop()
            self._came.clear()
            self._handlers[number](number, frame)

    def take(self, number: int, frame: FrameType | None) -> None:
        """Let a signal wait, unless it is the second."""
        again = bool(self._came)
        self._came.append((number, frame))
        if again or os.getpid() != self._process:  # a worker that was forked off has no steps
            self()


@contextlib.contextmanager
def between_steps() -> Iterator[DeferredSignals]:
    """Inside, Ctrl-C and SIGTERM wait until the yielded object is called, between two steps.

    A second signal does not wait. Outside the main thread the block changes nothing.
    """
    before = {number: signal.getsignal(number) for number in (signal.SIGINT, signal.SIGTERM)}
    main = threading.current_thread() is threading.main_thread()
    known = {int(n): each for n, each in before.items() if main and callable(each)}
    waiting = DeferredSignals(known)
    take = waiting.take  # one object, to be known again
    for number in known:
        signal.signal(number, take)
    try:
        yield waiting
    finally:
        for number, handler in known.items():
            if signal.getsignal(number) is take:
                signal.signal(number, handler)
    waiting()
