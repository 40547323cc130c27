"""Save what was learned when SIGTERM arrives: clusters send it before they end a job."""

from __future__ import annotations

import contextlib
import os
import signal
import threading
from collections.abc import Iterator
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
