"""Seconds of the fuzz target: any bytes as one call. docs/how-to/sanitize.md has the hours."""

import random

import pytest
from native.sanitize import building
from native.sanitize.building import MEMORY, Toolchain

pytestmark = pytest.mark.slow


def test_any_bytes_are_survived(toolchain: Toolchain) -> None:
    before = building.wrapper(toolchain, MEMORY)
    program = toolchain.program("fuzz/fuzz_target.cpp", "baseline", MEMORY)
    limits = ["--inputs", "1000", "--seconds", "20"]
    tally = building.run([*before, str(program), *limits], toolchain.folder)
    for kind in ("calls", "drew", "backward", "refused"):
        assert tally[kind] > 20, kind


def test_inputs_on_disk_are_replayed(toolchain: Toolchain) -> None:
    before = building.wrapper(toolchain, MEMORY)
    program = toolchain.program("fuzz/fuzz_target.cpp", "baseline", MEMORY)
    files = []
    for size in (0, 1, 3, 64, 5000):
        file = toolchain.folder / f"input_{size}.bin"
        file.write_bytes(random.Random(size).randbytes(size))
        files.append(str(file))
    tally = building.run([*before, str(program), *files], toolchain.folder)
    assert tally["calls"] == len(files)
