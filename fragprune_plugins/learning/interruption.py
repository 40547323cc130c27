"""Save what was learned when SIGTERM arrives: clusters send it before they end a job."""

from __future__ import annotations

import contextlib
import os
import signal
import sys
import threading
from collections.abc import Callable, Iterator
from types import FrameType

EXIT_CODE = 128 + signal.SIGTERM
"""Exit code that a shell reports for a process which SIGTERM ended: 143."""

_AFTER_A_FINALIZER = 0.02  # seconds


class Terminate(KeyboardInterrupt):
    """SIGTERM as an exception in the main thread. Handlers of Ctrl-C catch it too."""


@contextlib.contextmanager
def sigterm_interrupts() -> Iterator[None]:
    """Raise ``Terminate`` on the first SIGTERM inside the block, and ignore later ones.

    Python drops an exception that a signal raises inside a finalizer; then it is raised again.
    Outside the main thread, or if SIGTERM is already ignored, the block changes nothing.
    """
    before = signal.getsignal(signal.SIGTERM)
    main = threading.current_thread() is threading.main_thread()
    if not main or before in (None, signal.SIG_IGN):
        yield
        return
    process, unraisable = os.getpid(), sys.unraisablehook

    def interrupt(number: int, frame: FrameType | None) -> None:
        if os.getpid() != process:  # a worker that was forked off: it has nothing to save
            os._exit(EXIT_CODE)
        signal.signal(number, signal.SIG_IGN)
        raise Terminate

    def dropped(report: sys.UnraisableHookArgs) -> None:
        if not isinstance(report.exc_value, Terminate):
            unraisable(report)
            return
        signal.signal(signal.SIGTERM, interrupt)
        again = threading.Timer(_AFTER_A_FINALIZER, signal.raise_signal, (signal.SIGTERM,))
        again.daemon = True
        again.start()

    signal.signal(signal.SIGTERM, interrupt)
    sys.unraisablehook = dropped
    try:
        yield
    finally:
        if sys.unraisablehook is dropped:
            sys.unraisablehook = unraisable
        signal.signal(signal.SIGTERM, before)


class Waiting:
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
def between_steps() -> Iterator[Waiting]:
    """Inside, Ctrl-C and SIGTERM wait until the yielded object is called, between two steps.

    So what is kept then is the state after a whole step. A second signal does not wait. Outside the
    main thread the block changes nothing.
    """
    before = {number: signal.getsignal(number) for number in (signal.SIGINT, signal.SIGTERM)}
    main = threading.current_thread() is threading.main_thread()
    known = {int(n): each for n, each in before.items() if main and callable(each)}
    waiting = Waiting(known)
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
