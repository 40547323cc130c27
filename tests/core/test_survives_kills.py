"""Files are whole, and a model and its sidecar belong together, whatever ends the process."""

import contextlib
import os
import signal
import sys
import time
from collections.abc import Callable
from functools import partial
from pathlib import Path

import pytest
import torch
from finetune import tiny

import fragprune_plugins as fp
from fragprune_plugins.errors import OutputError
from fragprune_plugins.files import atomic, sidecar
from fragprune_plugins.files.ply import read_ply
from fragprune_plugins.workbench.models.formats.ply import write_ply

SPLAT = tiny.random_model(20)


def save(path: Path, generation: int, kind: str = "pair") -> None:
    """Save a model all of whose numbers tell its generation.

    A "pair" is what a host's save becomes, a model "alone" has nothing to hold, and "one" is a file
    of ours, which holds its thresholds.
    """
    splat = fp.Model(**vars(SPLAT) | {"opacity": torch.full((20, 1), float(generation))})
    cut = tiny.cut(splat, 1 / (2.0 + generation))
    if kind != "pair":
        fp.save(path, cut if kind == "one" else splat)
        return
    with atomic.staging(path) as folder:
        write_ply(folder / path.name, splat)
        sidecar.replace_pair(path, folder / path.name, cut.thresholds)


def generation(path: Path) -> int:
    """Of both parts of a pair, loaded as every reader loads it."""
    splat = fp.load(path)
    found = int(splat.opacity[0])
    if splat.falloff is not None:
        assert torch.allclose(splat.falloff, torch.tensor(1 / (2.0 + found)))
    assert (splat.opacity == found).all()
    return found


def names(path: Path) -> list[str]:
    return sorted(each.name for each in path.parent.iterdir())


class Child:
    """A forked process that runs something and ends without a word."""

    def __init__(self, work: Callable[[], None]) -> None:
        self.pid = os.fork()
        if self.pid == 0:
            with contextlib.suppress(BaseException):
                work()
                os._exit(0)
            os._exit(1)

    def kill(self) -> None:
        os.kill(self.pid, signal.SIGKILL)

    def wait(self) -> int:
        return os.waitstatus_to_exitcode(os.waitpid(self.pid, 0)[1])


CHANGES = ("os.rename", "os.remove", "os.rmdir", "os.mkdir", "os.link", "os.symlink", "os.truncate")


def dies_before_change(number: int, work: Callable[[], None]) -> None:
    """Run, and die before the so-manieth call that changes the file system."""
    left = number

    def count(event: str, given: tuple) -> None:
        nonlocal left
        writes = event == "open" and given[2] & (os.O_WRONLY | os.O_RDWR | os.O_CREAT)
        if event in CHANGES or writes:
            left -= 1
            if left == 0:
                os.kill(os.getpid(), signal.SIGKILL)

    sys.addaudithook(count)
    work()


@pytest.mark.parametrize(
    ("old", "new"),
    [("nothing", "pair"), ("pair", "pair"), ("pair", "alone"), ("alone", "pair"), ("one", "one")],
)
def test_after_a_death_at_any_change_the_old_pair_or_the_new_one_is_there(tmp_path, old, new):
    path, number, seen = tmp_path / "a.ply", 0, []
    save(path, 1)  # whatever is imported late, is now
    ended = False
    while not ended:
        number += 1
        for each in tmp_path.iterdir():
            each.unlink()
        if old != "nothing":
            save(path, 1, old)
        child = Child(partial(dies_before_change, number, lambda: save(path, 2, new)))
        ended = child.wait() == 0
        seen.append(generation(path) if path.exists() else None)
        save(path, 3, new)
        assert generation(path) == read_ply(path).opacity[0] == 3  # as other viewers read it
        assert names(path) == ["a.fragprune.safetensors", "a.ply"][new != "pair" :]
    assert number > 8
    first = None if old == "nothing" else 1
    turn = seen.index(2)
    assert seen == [first] * turn + [2] * (len(seen) - turn)  # one moment decides
    assert turn > 4


def test_each_file_is_on_disk_before_its_name_and_that_before_the_next(tmp_path, monkeypatch):
    done: list[tuple[str, object]] = []
    fsync, replace = os.fsync, os.replace

    def syncing(handle: int) -> None:
        done.append(("sync", os.fstat(handle).st_ino))
        fsync(handle)

    def renaming(old: Path, new: Path) -> None:
        done.append(("rename", os.stat(old).st_ino))
        replace(old, new)

    path = tmp_path / "a.ply"
    save(path, 1)
    monkeypatch.setattr(os, "fsync", syncing)
    monkeypatch.setattr(os, "replace", renaming)
    save(path, 2)
    folder = ("sync", tmp_path.stat().st_ino)
    # Each file is written aside by its own writer; the three last names are those of the pair.
    renames = [i for i, (what, _) in enumerate(done) if what == "rename"][-3:]
    for i in renames:
        assert done[i + 1] == folder
    assert all(("sync", done[i][1]) in done[:i] for i in renames)


def test_a_reader_sees_whole_pairs_while_two_processes_write(tmp_path):
    path = tmp_path / "a.ply"
    save(path, 1)

    def write(first: int) -> None:
        for count in range(first, 1000, 2):
            save(path, count)

    writers = [Child(lambda i=i: write(i)) for i in (2, 3)]
    try:
        seen = {generation(path) for _ in range(60)}
    finally:
        for writer in writers:
            writer.kill()
            writer.wait()
    assert len(seen) > 1
    save(path, 1)
    assert names(path) == ["a.fragprune.safetensors", "a.ply"]


def test_a_living_writer_is_waited_for_and_a_dead_one_is_cleared_away(tmp_path, monkeypatch):
    path = tmp_path / "a.ply"
    save(path, 1)
    ready, told = os.pipe()

    def hold() -> None:
        with atomic.replacing(path) as new:
            new.write_text("half")
            os.write(told, b"x")
            time.sleep(60)

    child = Child(hold)
    os.read(ready, 1)
    monkeypatch.setattr(atomic, "WAIT", 0.1)
    with pytest.raises(OutputError, match="being written by another process"):
        save(path, 2)
    assert any(name.startswith(".fragprune-") for name in names(path))  # not taken from under it
    assert generation(path) == 1
    child.kill()
    child.wait()
    save(path, 3)
    assert names(path) == ["a.fragprune.safetensors", "a.ply"]


def test_what_is_left_of_other_files_stays(tmp_path):
    others = [".fragprune-0123456789ab-new-x", ".a.ply.backup", "a.0123456789abcdef.ply"]
    for name in others:
        (tmp_path / name).write_text("mine")
    save(tmp_path / "a.ply", 1)
    assert names(tmp_path / "a.ply") == sorted([*others, "a.fragprune.safetensors", "a.ply"])


def test_the_same_model_without_thresholds_leaves_no_sidecar_behind(tmp_path):
    """Thresholds that were written beside a file do not change its bytes."""
    path = tmp_path / "out.ply"
    save(path, 1, "alone")
    sidecar.save(path, fp.ThresholdStore.from_falloff(torch.full((20,), 0.2)))
    save(path, 1, "alone")
    assert names(path) == ["out.ply"]
    assert fp.load(path).thresholds is None


def test_a_new_sidecar_counts_more_than_one_that_a_dead_process_left_at_an_address(tmp_path):
    path = tmp_path / "out.ply"
    save(path, 1)
    left = sidecar._address(path, atomic.digest(path))
    os.replace(sidecar.path_beside(path), left)
    new = fp.ThresholdStore.from_falloff(torch.full((20,), 0.2))
    sidecar.save(path, new)
    assert not left.exists()
    assert torch.equal(fp.load(path).thresholds.values, new.values)


def test_a_sidecar_at_its_address_counts_for_that_content_alone(tmp_path):
    path = tmp_path / "a.ply"
    save(path, 1)
    content = path.read_bytes()
    beside = sidecar.path_beside(path)
    os.replace(beside, sidecar._address(path, atomic.digest(path)))
    assert sidecar.belongs(path)
    assert generation(path) == 1
    assert fp.load(path).thresholds is not None
    path.write_bytes(content + b"more")
    assert sidecar.find(path) is None


@pytest.mark.parametrize("failing", [1, 2, 3])
def test_a_full_disk_at_any_rename_leaves_a_whole_pair_alone(tmp_path, monkeypatch, failing):
    path, count, replace = tmp_path / "a.ply", 0, os.replace
    save(path, 1)

    def full(old: Path, new: Path) -> None:
        nonlocal count
        count += Path(new).parent == tmp_path
        if count == failing:
            raise OSError(28, "No space left on device")
        replace(old, new)

    monkeypatch.setattr(os, "replace", full)
    with pytest.raises(OutputError, match="No space left"):
        save(path, 2)
    monkeypatch.undo()
    assert generation(path) == (2 if failing == 3 else 1)
    save(path, 3)
    assert names(path) == ["a.fragprune.safetensors", "a.ply"]


def test_a_name_as_long_as_the_system_allows(tmp_path):
    path = tmp_path / ("n" * 233 + ".ply")  # with the sidecar's ending 255
    save(path, 1)
    assert generation(path) == 1
