"""Seconds of broken files: each is read, or refused with what is wrong; see docs/how-to/fuzz.md."""

import os
import shutil
import signal
import socket

import pytest
from campaigns.fuzz import commands, seeds
from campaigns.fuzz.readers import READERS, Reader
from campaigns.fuzz.running import BAD, GOOD, Nonsense, broken, judge, run

from fragprune_plugins.errors import RecordError

INPUTS = 30


@pytest.mark.parametrize("reader", READERS, ids=lambda reader: reader.name)
def test_seeds_are_read_and_what_was_found_is_stated(reader, tmp_path):
    seeded = seeds.good()[reader.name]
    assert seeded
    for name, content in (seeded | reader.found()).items():
        outcome = judge(reader, content, tmp_path / "input")
        assert outcome[0] in (("read",) if name in seeded else GOOD), (name, *outcome)


@pytest.mark.parametrize("reader", READERS, ids=lambda reader: reader.name)
def test_broken_files_are_stated(reader, tmp_path):
    pool = reader.pool()
    for number in range(INPUTS):
        content = broken(reader.name, pool, 20, number)
        kind, words = judge(reader, content, tmp_path / "input")
        assert kind in GOOD, (number, words)


def test_every_reader_has_seeds_and_every_finding_a_reader():
    names = {reader.name for reader in READERS}
    assert seeds.good().keys() == names
    assert {path.name for path in seeds.CORPUS.iterdir()} <= names


@pytest.mark.parametrize("reader", [commands.COMMANDS[-3]], ids=lambda reader: reader.name)
def test_commands_state_what_is_wrong_with_a_broken_file(reader, tmp_path):
    assert judge(reader, b"{", tmp_path / "input")[0] == "stated"
    assert judge(reader, reader.pool()[0], tmp_path / "input")[0] == "read"


def test_no_command_uses_the_network(tmp_path, monkeypatch):
    for name in ("socket", "create_connection", "getaddrinfo"):
        monkeypatch.setattr(socket, name, None)
    shutil.copytree(commands.scene(), tmp_path / "scene")
    for name in commands.NAMES:
        commands.command(name, tmp_path / "scene")


def raising(error):
    def read(file):
        raise error

    return read


def crash(file):
    os.kill(os.getpid(), signal.SIGKILL)


def devour(file):
    bytearray(1 << 32)


@pytest.mark.parametrize(
    ("read", "kind"),
    [
        (raising(ValueError("raw")), "foreign"),
        (raising(Nonsense("NaN")), "nonsense"),
        (raising(RecordError("", "", "", "")), "nonsense"),
        (raising(RecordError("a", "b", "c", "d")), "stated"),
        (lambda file: None, "read"),
        (devour, "foreign"),
        (crash, "crash"),
    ],
    ids=["foreign", "nonsense", "empty words", "stated", "read", "memory", "crash"],
)
def test_the_runner_sees_each_outcome_and_goes_on(read, kind):
    tally = run(Reader("git", read), 3)
    assert tally.outcomes == {kind: 3}
    assert (tally.bad > 0) == (kind in BAD)
    assert bool(tally.found) == (kind in BAD)


def test_a_reader_that_hangs_is_ended(monkeypatch):
    def hang(file):
        while True:
            pass

    monkeypatch.setattr("campaigns.fuzz.running.HANG", 0.2)
    assert run(Reader("git", hang), 2).outcomes == {"hang": 2}
