"""The machinery of the attacks, and some of them; ``python -m tests.attack`` runs all."""

from __future__ import annotations

import os
import signal
import time
from collections import Counter

import pytest
from attack.attacks import ATTACKS, Options
from attack.hostile import GOOD
from attack.running import BAD, FINE, Result, in_child, judged, raised, table

from fragprune_plugins.errors import InputError


def fails(error):
    def act():
        raise error

    return act


@pytest.mark.parametrize(
    ("act", "kind"),
    [
        (lambda: ("fine", ""), "fine"),
        (lambda: raised(fails(InputError("a", "b", "c", "d"))), "stated"),
        (lambda: raised(fails(KeyError("a"))), "traceback"),
        (fails(SystemExit(3)), "traceback"),
        (lambda: os.kill(os.getpid(), signal.SIGKILL), "crash"),
        (lambda: time.sleep(60), "hang"),
        (lambda: bytearray(1 << 36) and None, "traceback"),
    ],
    ids=["fine", "stated", "raised", "exit", "crash", "hang", "memory"],
)
def test_however_an_attack_ends_it_is_seen(act, kind):
    assert in_child(act, patience=2 if kind == "hang" else 60)[0] == kind


@pytest.mark.parametrize(
    ("name", "came", "is_"),
    [
        ("broken", "fine", "nonsense"),
        ("broken", "stated", "stated"),
        ("broken", "warned", "warned"),
        ("broken", "hang", "hang"),
        (GOOD + "whole", "fine", "fine"),
        (GOOD + "whole", "stated", "nonsense"),
    ],
)
def test_a_hostile_input_has_to_be_refused_and_a_good_one_accepted(name, came, is_):
    assert judged(name, (came, "words"))[0] == is_


def test_the_table_counts_every_input():
    result = Result(Counter(fine=2, stated=3, crash=1))
    assert (result.inputs, result.bad) == (6, 1)
    lines = table([("an attack", result, 1.4)]).splitlines()
    assert lines[2] == "| an attack | 6 | 2 | 3 | 0 | 0 | 0 | 1 | 0 | 1 |"
    assert lines[2].replace("an attack", "all") == lines[3]
    assert len(FINE) + len(BAD) == 7


@pytest.mark.parametrize(
    "name",
    [
        "malicious and broken checkpoints",
        "commands without a network",
        "requests to the viewer's server",
    ],
)
def test_an_attack_finds_nothing(name, tmp_path):
    result = ATTACKS[name](Options(tmp_path, inputs=20, seed=3))
    assert result.inputs > 3
    assert result.found == []
