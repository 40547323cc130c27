import contextlib
import os
import pty
import signal
import sys
import threading
import time

import pytest

from fragprune_plugins.learning.deferred import between_steps
from fragprune_plugins.learning.interruption import Terminate, sigterm_interrupts


@pytest.fixture(autouse=True)
def handler():
    """Signals as a process has them that nobody prepared, and that runs at a terminal."""
    before = signal.signal(signal.SIGTERM, signal.SIG_DFL)
    ctrl_c = signal.signal(signal.SIGINT, signal.default_int_handler)
    yield
    signal.signal(signal.SIGTERM, before)
    signal.signal(signal.SIGINT, ctrl_c)


def test_sigterm_interrupts_as_ctrl_c_does_and_once():
    with sigterm_interrupts():
        with pytest.raises(KeyboardInterrupt) as caught:
            signal.raise_signal(signal.SIGTERM)
        signal.raise_signal(signal.SIGTERM)  # while what was learned is being saved
    assert caught.type is Terminate
    assert signal.getsignal(signal.SIGTERM) is signal.SIG_DFL


def test_the_handler_before_is_back_however_it_ended():
    def own(*_):
        pass

    signal.signal(signal.SIGTERM, own)
    with sigterm_interrupts():
        assert signal.getsignal(signal.SIGTERM) is not own
    assert signal.getsignal(signal.SIGTERM) is own
    with pytest.raises(ZeroDivisionError), sigterm_interrupts():
        raise ZeroDivisionError
    assert signal.getsignal(signal.SIGTERM) is own


@pytest.mark.parametrize("number", [signal.SIGTERM, signal.SIGHUP])
def test_who_has_it_ignored_is_left_alone(number):
    """As a closed terminal's under nohup."""
    before = signal.signal(number, signal.SIG_IGN)
    try:
        with sigterm_interrupts():
            signal.raise_signal(number)
            assert signal.getsignal(number) is signal.SIG_IGN
        assert signal.getsignal(number) is signal.SIG_IGN
    finally:
        signal.signal(number, before)


CLOSED = """
import signal, sys, time
from pathlib import Path
from fragprune_plugins.learning.interruption import Terminate, sigterm_interrupts

signal.signal(signal.SIGHUP, signal.SIG_DFL)  # under nohup it is inherited as ignored
with sigterm_interrupts():
    try:
        print("ready", flush=True)
        time.sleep(60)
    except Terminate:
        print("saving", flush=True)
        print("saving", file=sys.stderr, flush=True)
        Path(sys.argv[1]).write_text("saved")
"""


def test_what_was_learned_is_saved_when_the_terminal_is_closed(tmp_path):
    """Whatever is written to it fails then."""
    saved = tmp_path / "saved"
    process, terminal = pty.fork()
    if process == 0:
        os.execv(sys.executable, [sys.executable, "-c", CLOSED, str(saved)])
    while b"ready" not in os.read(terminal, 1000):
        pass
    os.close(terminal)
    _, status = os.waitpid(process, 0)
    assert (os.waitstatus_to_exitcode(status), saved.exists()) == (0, True)


def test_where_no_terminal_hangs_up_there_is_sigterm_alone(monkeypatch):
    """As on Windows."""
    monkeypatch.delattr(signal, "SIGHUP")
    with pytest.raises(Terminate), sigterm_interrupts():
        signal.raise_signal(signal.SIGTERM)


@pytest.mark.parametrize("guarded", [sigterm_interrupts, between_steps])
def test_another_thread_than_the_main_one_changes_nothing(guarded):
    seen = []

    def handlers():
        return signal.getsignal(signal.SIGTERM), signal.getsignal(signal.SIGINT)

    def inside():
        with guarded() as now:
            seen.append(handlers())
            if now is not None:
                now()

    before = handlers()
    thread = threading.Thread(target=inside)
    thread.start()
    thread.join()
    assert seen == [before]


@pytest.mark.parametrize("further", [contextlib.nullcontext, between_steps])
def test_a_forked_worker_just_ends(further):
    with sigterm_interrupts(), further():
        child = os.fork()
        if child == 0:
            signal.raise_signal(signal.SIGTERM)
            os._exit(0)
        _, status = os.waitpid(child, 0)
    assert os.waitstatus_to_exitcode(status) == 143


def test_between_steps_a_signal_waits_and_a_second_one_does_not():
    with sigterm_interrupts():
        with between_steps() as now:
            signal.raise_signal(signal.SIGTERM)
            with pytest.raises(Terminate):
                now()
            now()
        with between_steps() as now:
            signal.raise_signal(signal.SIGINT)
            with pytest.raises(KeyboardInterrupt):
                signal.raise_signal(signal.SIGINT)
            now()
    assert signal.getsignal(signal.SIGINT) is signal.default_int_handler


def test_a_signal_in_the_last_step_is_not_lost():
    with pytest.raises(KeyboardInterrupt), between_steps():
        signal.raise_signal(signal.SIGINT)


def test_sigterm_inside_a_finalizer_is_not_lost():
    """Python drops what a finalizer raises."""

    class Released:
        def __del__(self):
            signal.raise_signal(signal.SIGTERM)
            time.sleep(0)  # the handler runs here at the latest

    @sigterm_interrupts()
    def work():
        Released()
        while True:
            time.sleep(0.001)

    before = sys.unraisablehook
    with pytest.raises(Terminate):
        work()
    assert sys.unraisablehook is before
