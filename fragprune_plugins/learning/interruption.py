"""SIGTERM while something learns: clusters send it, and what was learned is to be saved first."""

from __future__ import annotations

import contextlib
import os
import signal
import threading
from collections.abc import Iterator
from types import FrameType

EXIT_CODE = 128 + signal.SIGTERM
"""What a shell reports of a process that SIGTERM ended: 143."""


class Terminate(KeyboardInterrupt):
    """SIGTERM, where it found the main thread; what catches Ctrl-C catches it."""


@contextlib.contextmanager
def sigterm_interrupts() -> Iterator[None]:
    """Inside, the first SIGTERM raises ``Terminate`` and later ones wait for the end.

    Does nothing in a thread that gets no signals, or where somebody has SIGTERM ignored.
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
