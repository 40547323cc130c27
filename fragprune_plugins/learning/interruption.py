"""Save what was learned when SIGTERM arrives: clusters send it before they end a job."""

from __future__ import annotations

import contextlib
import os
import signal
import threading
from collections.abc import Callable, Iterator
from types import FrameType

EXIT_CODE = 128 + signal.SIGTERM
"""Exit code that a shell reports for a process which SIGTERM ended: 143."""


class Terminate(KeyboardInterrupt):
    """SIGTERM as an exception in the main thread. Handlers of Ctrl-C catch it too."""


@contextlib.contextmanager
def sigterm_interrupts() -> Iterator[None]:
    """Raise ``Terminate`` on the first SIGTERM inside the block, and ignore later ones.

    Outside the main thread, or if SIGTERM is already ignored, the block changes nothing.
    """
    before = signal.getsignal(signal.SIGTERM)
    main = threading.current_thread() is threading.main_thread()
    if not main or before in (None, signal.SIG_IGN):
        yield
        return
    process = os.getpid()

    def interrupt(number: int, frame: FrameType | None) -> None:
        if os.getpid() != process:  # a worker that was forked off: it has nothing to save
            os._exit(EXIT_CODE)
        signal.signal(number, signal.SIG_IGN)
        raise Terminate

    signal.signal(signal.SIGTERM, interrupt)
    try:
        yield
    finally:
        signal.signal(signal.SIGTERM, before)


@contextlib.contextmanager
def between_steps() -> Iterator[Callable[[], None]]:
    """Inside, Ctrl-C and SIGTERM wait until the yielded function is called, between two steps.

    So what is kept then is the state after a whole step. A second signal does not wait. Outside the
    main thread the block changes nothing.
    """
    process, waiting = os.getpid(), list[tuple[int, FrameType | None]]()
    before = {number: signal.getsignal(number) for number in (signal.SIGINT, signal.SIGTERM)}
    main = threading.current_thread() is threading.main_thread()
    known = {n: each for n, each in before.items() if main and callable(each)}

    def wait(number: int, frame: FrameType | None) -> None:
        again = bool(waiting)
        waiting.append((number, frame))
        if again or os.getpid() != process:  # a worker that was forked off has no steps
            now()

    def now() -> None:
        if waiting:
            number, frame = waiting.pop()
            waiting.clear()
            known[signal.Signals(number)](number, frame)

    for number in known:
        signal.signal(number, wait)
    try:
        yield now
    finally:
        for number, handler in known.items():
            if signal.getsignal(number) is wait:
                signal.signal(number, handler)
    now()
