"""Seconds of the fuzz target: any bytes as one call. docs/how-to/sanitize.md has the hours."""

import random

import pytest
from native.sanitize.building import MEMORY

pytestmark = pytest.mark.slow
TARGET = "fuzz/fuzz_target.cpp", "baseline", MEMORY


def test_any_bytes_are_survived(toolchain):
    tally = toolchain.tally(*TARGET, "--inputs", 1000, "--seconds", 20)
    for kind in ("calls", "drew", "backward", "refused"):
        assert tally[kind] > 20, kind


def test_inputs_on_disk_are_replayed(toolchain):
    sizes = (0, 1, 3, 64, 5000)
    files = [toolchain.folder / f"input_{size}.bin" for size in sizes]
    for file, size in zip(files, sizes, strict=True):
        file.write_bytes(random.Random(size).randbytes(size))
    assert toolchain.tally(*TARGET, *files)["calls"] == len(files)
