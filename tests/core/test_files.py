import errno
import hashlib
import os
import time
import tracemalloc
from pathlib import Path
from threading import Thread

import pytest

from fragprune_plugins.errors import OutputError
from fragprune_plugins.files import atomic
from fragprune_plugins.files.atomic import all_in_flight, digest, in_flight, locked, put, replacing
from fragprune_plugins.workbench.models.model import writable_folder


def test_the_new_file_appears_whole_under_its_name(tmp_path):
    target = tmp_path / "new" / "folder" / "a.txt"
    with replacing(target) as temporary:
        assert temporary.name == target.name
        temporary.write_text("whole")
        assert not target.exists()
    assert target.read_text() == "whole"
    assert list(target.parent.iterdir()) == [target]


@pytest.mark.parametrize("error", [ValueError("ours"), KeyboardInterrupt(), OSError(28, "full")])
def test_whatever_fails_inside_the_old_file_stays_and_nothing_else_does(tmp_path, error):
    target = tmp_path / "a.txt"
    target.write_text("old")

    def fail_half_way():
        with replacing(target) as temporary:
            temporary.write_text("half")
            raise error

    expected = OutputError if isinstance(error, OSError) else type(error)
    with pytest.raises(expected):
        fail_half_way()
    assert target.read_text() == "old"
    assert list(tmp_path.iterdir()) == [target]


def test_a_file_where_a_folder_should_be_is_stated_and_a_pipe_where_a_file_should(tmp_path):
    (tmp_path / "file").write_text("")
    with pytest.raises(OutputError, match="cannot be written"), replacing(tmp_path / "file" / "x"):
        pass
    os.mkfifo(pipe := tmp_path / "pipe")
    with pytest.raises(OutputError, match=r"\(a pipe or device\)"), replacing(pipe) as new:
        new.touch()
    assert pipe.is_fifo()


@pytest.mark.parametrize("mask", [0o022, 0o077])
@pytest.mark.parametrize("way", ["put", "durable", "plain"])
def test_permissions_follow_the_users_mask_and_the_mask_stays(tmp_path, mask, way):
    before = os.umask(mask)
    try:
        if way == "put":
            (tmp_path / "new").touch(0o600)
            put(tmp_path / "new", tmp_path / "a")
        else:
            with replacing(tmp_path / "a", durable=way == "durable") as new:
                new.touch(0o600)
        assert os.umask(mask) == mask
    finally:
        os.umask(before)
    assert (tmp_path / "a").stat().st_mode & 0o777 == 0o666 & ~mask


def test_what_is_on_its_way_lies_beside_the_file_under_a_name_of_its_own(tmp_path):
    one, other = in_flight(tmp_path / "a.ply", "new"), in_flight(tmp_path / "b.ply", "new")
    assert one.parent == other.parent == tmp_path
    assert one.name != other.name
    key = hashlib.sha256(b"a.ply").hexdigest()[:12]
    assert one.name == f".fragprune-{key}-new"
    assert in_flight(tmp_path / "A.PLY", "new") == one  # some systems take them for one
    in_flight(tmp_path / "\udcff", "new")  # a name that is no text
    for name in ("for-2", "for-1", "lock"):
        in_flight(tmp_path / "a.ply", name).touch()
    in_flight(tmp_path / "b.ply", "for-3").touch()
    found = [each.name[-5:] for each in all_in_flight(tmp_path / "a.ply", "for-*")]
    assert found == ["for-1", "for-2"]
    assert all_in_flight(tmp_path / "none" / "a.ply", "*") == []


def test_a_lock_is_for_one_at_a_time_and_leaves_nothing(tmp_path, monkeypatch):
    monkeypatch.setattr(atomic, "WAIT", 0.0)
    path = tmp_path / "a.txt"
    with locked(path) as alone:
        assert alone
        with locked(path, what="another"), locked(tmp_path / "b.txt"):
            pass
        with pytest.raises(OutputError, match=f"{path}: .*another process"), locked(path):
            pass
    with locked(path):
        pass
    assert list(tmp_path.iterdir()) == []


def test_who_waits_for_a_lock_gets_it_after_its_file_was_removed(tmp_path):
    path, order = tmp_path / "a.txt", []

    def wait():
        with locked(path, wait=20):
            order.append("next")

    with locked(path):
        waiting = Thread(target=wait)
        waiting.start()
        time.sleep(0.1)
        order.append("first")
    waiting.join()
    assert order == ["first", "next"]
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize("number", [errno.ENOLCK, errno.EOPNOTSUPP, errno.EROFS, errno.EIO])
def test_where_there_are_no_locks_writing_goes_on_without(tmp_path, monkeypatch, number):
    def flock(*_):
        in_flight(tmp_path / "a.txt", "lock").unlink()  # as another process without locks may do
        raise OSError(number, "no")

    monkeypatch.setattr("fcntl.flock", flock)
    left = in_flight(tmp_path / "a.txt", "new-left")
    left.mkdir()
    if number == errno.EIO:
        with pytest.raises(OSError, match="no"), locked(tmp_path / "a.txt"):
            pass
        return
    with locked(tmp_path / "a.txt") as alone:
        assert alone is False
    with replacing(tmp_path / "a.txt") as new:
        new.write_text("whole")
    assert left.exists()  # of whom, nobody can tell
    assert sorted(tmp_path.iterdir()) == [left, tmp_path / "a.txt"]


def test_a_writable_folder_is_made_and_left_empty(tmp_path):
    for _ in range(2):
        assert writable_folder(str(tmp_path / "a" / "b")) == tmp_path / "a" / "b"
    assert list((tmp_path / "a" / "b").iterdir()) == []
    (tmp_path / "file").write_text("")
    with pytest.raises(OutputError, match=r"/file/x: cannot be written \(Not a directory\);"):
        writable_folder(tmp_path / "file" / "x")


def test_digest_is_sha256_and_holds_no_file_in_memory(tmp_path):
    content = os.urandom(16 << 20)
    (tmp_path / "x").write_bytes(content)
    tracemalloc.start()
    found = digest(tmp_path / "x")
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    assert found == hashlib.sha256(content).hexdigest()
    assert peak < 8 << 20


@pytest.mark.skipif(not Path("/proc/self/fd").exists(), reason="needs a list of open files")
def test_waiting_for_a_lock_leaves_no_file_open(tmp_path):
    def waited():
        with pytest.raises(OutputError), locked(tmp_path / "a.txt", wait=0.1):
            pass

    with locked(tmp_path / "a.txt"):
        waited()
        before = len(os.listdir("/proc/self/fd"))
        waited()
        assert len(os.listdir("/proc/self/fd")) == before
