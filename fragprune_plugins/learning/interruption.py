"""Save what was learned when SIGTERM comes, before a job is ended, or a terminal is closed."""

from __future__ import annotations

import contextlib
import os
import signal
import sys
import threading
from collections.abc import Iterator
from pathlib import Path
from types import FrameType

EXIT_CODE = 128 + signal.SIGTERM  # a shell's, of a process that SIGTERM ended: 143
_AFTER_A_FINALIZER = 0.02  # seconds


class Terminate(KeyboardInterrupt):
    """SIGTERM as an exception in the main thread. Handlers of Ctrl-C catch it too."""


@contextlib.contextmanager
def sigterm_interrupts() -> Iterator[None]:
    """Raise ``Terminate`` on the first SIGTERM inside the block, and ignore later ones.

    So does SIGHUP, where a terminal is closed, unless somebody handles or ignores it.
    Python drops an exception that a signal raises inside a finalizer; then it is raised again.
    Outside the main thread, or if SIGTERM is already ignored, the block changes nothing.
    """
    before = signal.getsignal(signal.SIGTERM)
    main = threading.current_thread() is threading.main_thread()
    if not main or before in (None, signal.SIG_IGN):
        yield
        return
    process, unraisable = os.getpid(), sys.unraisablehook
    hangs_up = hasattr(signal, "SIGHUP") and signal.getsignal(signal.SIGHUP) is signal.SIG_DFL

    def interrupt(number: int, frame: FrameType | None) -> None:
        if os.getpid() != process:  # a worker that was forked off: it has nothing to save
            os._exit(EXIT_CODE)
        signal.signal(number, signal.SIG_IGN)
        raise Terminate

    def hung_up(number: int, frame: FrameType | None) -> None:
        signal.signal(number, signal.SIG_IGN)
        nowhere = os.open(os.devnull, os.O_WRONLY)
        for output in (1, 2):
            if not Path(f"/dev/fd/{output}").is_file():  # a terminal that is gone takes none
                os.dup2(nowhere, output)
        signal.raise_signal(signal.SIGTERM)

    def dropped(report: sys.UnraisableHookArgs) -> None:
        if not isinstance(report.exc_value, Terminate):
            unraisable(report)
            return
        signal.signal(signal.SIGTERM, interrupt)
        again = threading.Timer(_AFTER_A_FINALIZER, signal.raise_signal, (signal.SIGTERM,))
        again.daemon = True
        again.start()

    signal.signal(signal.SIGTERM, interrupt)
    if hangs_up:
        signal.signal(signal.SIGHUP, hung_up)
    sys.unraisablehook = dropped
    try:
        yield
    finally:
        if sys.unraisablehook is dropped:
            sys.unraisablehook = unraisable
        signal.signal(signal.SIGTERM, before)
        if hangs_up:
            signal.signal(signal.SIGHUP, signal.SIG_DFL)
