"""The machinery of ``campaigns.commands``, and a few of its inputs."""

import os
import signal
import time

import pytest
from campaigns import commands


def fails(error):
    def act():
        raise error

    return act


@pytest.mark.parametrize(
    ("act", "kind"),
    [
        (lambda: ("fine", ""), "fine"),
        (fails(KeyError("a")), "traceback"),
        (fails(SystemExit(3)), "traceback"),
        (lambda: os.kill(os.getpid(), signal.SIGKILL), "crash"),
        (lambda: time.sleep(60), "hang"),
        (lambda: bytearray(1 << 36) and None, "traceback"),
    ],
    ids=["fine", "raised", "exit", "crash", "hang", "memory"],
)
def test_however_a_child_ends_it_is_seen(act, kind):
    result = commands.Result()
    result.note("", commands.in_child(act, patience=0.5 if kind == "hang" else 60))
    assert result.outcomes == {kind: 1}
    assert bool(result.found) == (kind != "fine")


def test_broken_files_are_stated_and_a_good_scene_is_not_refused(tmp_path):
    assert commands.network(tmp_path, "orbit").found == []
    result = commands.broken(tmp_path, "cameras.json", 3, seed=3)
    assert result.found == []
    assert result.outcomes["stated"] > 3
