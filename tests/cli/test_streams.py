"""Commands in processes without streams, letters, or a folder to stand in."""

import errno
import os
import subprocess
import sys
from unittest.mock import Mock

import pytest

from fragprune_plugins.workbench import commands
from fragprune_spark import MODULE


def bridge(out, **how):
    words = [sys.executable, "-m", "fragprune_plugins", "bridge", "spark", "--out", str(out)]
    return subprocess.run(words, capture_output=True, timeout=100, **how)


@pytest.mark.parametrize("numbers", [(1,), (0, 1, 2)])
def test_a_file_never_takes_the_place_of_a_closed_stream(tmp_path, numbers):
    done = bridge(tmp_path, preexec_fn=lambda: [os.close(number) for number in numbers])
    assert done.returncode == 0
    assert (tmp_path / MODULE.name).read_bytes() == MODULE.read_bytes()


def test_a_stream_that_takes_nothing_is_a_closed_one():
    """As ``nice`` leaves it, where it was closed."""
    words = [sys.executable, "-m", "fragprune_plugins", "adapters"]
    with open(os.devnull) as null:
        done = subprocess.run(words, stdout=null, stderr=subprocess.PIPE, timeout=100)
    assert (done.returncode, done.stderr) == (0, b"")


def test_letters_that_a_stream_cannot_write_become_escapes(tmp_path):
    done = bridge(tmp_path / "\u2192", env=os.environ | {"PYTHONIOENCODING": "latin-1"})
    assert done.returncode == 0
    assert b"\\u2192" in done.stdout
    assert (tmp_path / "\u2192" / MODULE.name).exists()


@pytest.mark.skipif(not os.path.exists("/dev/full"), reason="no /dev/full")
@pytest.mark.parametrize("words", [["--help"], ["adapters"], ["adapters", "--json"]])
def test_a_stream_without_space_is_stated(words):
    with open("/dev/full", "w") as full:
        words = [sys.executable, "-m", "fragprune_plugins", *words]
        done = subprocess.run(words, stdout=full, stderr=subprocess.PIPE, timeout=100)
    assert done.returncode == 1
    assert done.stderr.startswith(b"[path] stdout: no space left")
    assert b"Traceback" not in done.stderr


def test_another_file_without_space_is_not_taken_for_the_stream(monkeypatch):
    """A host's, for one: Python names no file where a write fails."""
    full = OSError(errno.ENOSPC, "No space left on device")
    monkeypatch.setattr(commands, "cli", Mock(side_effect=full))
    with pytest.raises(OSError, match="No space left"):
        commands.main()


def test_a_folder_that_is_gone_is_stated(tmp_path):
    here = tmp_path / "here"
    here.mkdir()
    done = bridge(tmp_path / "out", cwd=here, preexec_fn=here.rmdir)
    assert done.returncode == 1
    assert done.stderr.startswith(b"[path]")
    assert b"Traceback" not in done.stderr
