"""Compiled kernels are kept: by source, macros, architecture and toolkit; whole or not at all."""

import errno
import os
import threading
import time

import filelock
import pytest

from fragprune_plugins.engines.cuda import kernels


class Slow:
    """Counts compilations, and takes its time."""

    name, architectures = "slow", (75, 90)

    def __init__(self, version: str = "1.0") -> None:
        self.version, self.count = version, 0

    def compile(self, source: str, macros: dict[str, int], target: str) -> kernels.Image:
        self.count += 1
        time.sleep(0.1)
        return kernels.Image(f"{source}{target}\n\0".encode(), "a log\nof two lines")


def test_the_second_time_costs_nothing(kept):
    slow = Slow()
    first, had = kernels.image_of("blend", {"A": 1}, "sm_90", slow)
    assert not had
    assert kernels.image_of("blend", {"A": 1}, "sm_90", slow) == (first, True)
    assert slow.count == 1


def test_whatever_changes_the_code_is_compiled_anew(kept, monkeypatch):
    slow = Slow()
    for source, macros, target in (
        ("blend", {}, "sm_90"),
        ("blend", {"A": 1}, "sm_90"),
        ("blend", {}, "sm_75"),
        ("scene", {}, "sm_90"),
    ):
        assert not kernels.image_of(source, macros, target, slow)[1]
    assert not kernels.image_of("blend", {}, "sm_90", Slow("1.1"))[1]
    monkeypatch.setattr(kernels, "digest_of_sources", lambda: b"edited")
    assert not kernels.image_of("blend", {}, "sm_90", slow)[1]


@pytest.mark.skipif(os.name != "posix", reason="other permissions")
def test_what_one_user_builds_others_may_read(kept):
    """As kernels in a folder that a cluster's jobs share."""
    before = os.umask(0o022)
    try:
        kernels.image_of("blend", {}, "sm_90", Slow())
    finally:
        os.umask(before)
    (path,) = kept.glob("*.bin")
    assert path.stat().st_mode & 0o777 == 0o644


def test_damaged_files_are_compiled_anew(kept):
    slow = Slow()
    whole, _ = kernels.image_of("blend", {}, "sm_90", slow)
    (path,) = kept.glob("*.bin")
    for damage in (b"", path.read_bytes()[:-1], path.read_bytes() + b"\0", b"\xff" * 100):
        path.write_bytes(damage)
        assert kernels.image_of("blend", {}, "sm_90", slow) == (whole, False)
    assert kernels.image_of("blend", {}, "sm_90", slow) == (whole, True)


def test_those_who_want_the_same_wait_for_the_first(kept):
    slow, found = Slow(), []
    crowd = [
        threading.Thread(target=lambda: found.append(kernels.image_of("a", {}, "sm_90", slow)))
        for _ in range(5)
    ]
    for thread in crowd:
        thread.start()
    for thread in crowd:
        thread.join()
    assert slow.count == 1
    assert sorted(had for _, had in found) == [False, True, True, True, True]


@pytest.mark.parametrize(
    "refusal", [NotImplementedError("no flock"), OSError(errno.ENOLCK, "no locks")], ids=type
)
def test_where_files_cannot_be_locked_they_are_kept_all_the_same(kept, monkeypatch, refusal):
    def refuse(*_: object, **__: object) -> None:
        raise refusal

    monkeypatch.setattr(filelock.FileLock, "acquire", refuse)
    slow = Slow()
    first, had = kernels.image_of("blend", {}, "sm_90", slow)
    assert not had
    assert kernels.image_of("blend", {}, "sm_90", slow) == (first, True)


def test_without_a_folder_nothing_is_kept(tmp_path, monkeypatch):
    file = tmp_path / "file"
    file.touch()
    monkeypatch.setenv(kernels.CACHE, str(file / "folder"))
    slow = Slow()
    for _ in range(2):
        assert not kernels.image_of("blend", {}, "sm_90", slow)[1]
    assert slow.count == 2


def test_the_environment_switches_the_compiler_off(monkeypatch):
    monkeypatch.setenv(kernels.ENVIRONMENT, "off")
    with pytest.raises(kernels.Unavailable, match="switched off"):
        kernels.compiler()
