"""What a step frees is there for the next one; memory that no machine has is refused."""

import platform
import subprocess
import sys

import pytest

STEPS = """
import ctypes, resource, sys
from fragprune_plugins.engines.cpu.memory import keep_freed_memory
kinds, *sizes = sys.argv[1:]
for kind in filter(None, kinds.split(", ")):
    print(keep_freed_memory(growing=kind == "growing"))
libc, sizes = ctypes.CDLL(None), [int(size) << 20 for size in sizes]
libc.malloc.restype, libc.free.argtypes = ctypes.c_void_p, [ctypes.c_void_p]
for step in range(9):
    if step == 4:
        before = resource.getrusage(resource.RUSAGE_SELF).ru_minflt
    blocks = [libc.malloc(size) for size in sizes]
    for block, size in zip(blocks, sizes):
        ctypes.memset(block, 1, size)
    for block in blocks:
        libc.free(block)
print(resource.getrusage(resource.RUSAGE_SELF).ru_minflt - before)
"""


def faults(kinds: str, *mebibytes: int) -> int:
    words = [sys.executable, "-c", STEPS, kinds, *map(str, mebibytes)]
    done = subprocess.run(words, capture_output=True, text=True, check=True)
    *said, count = done.stdout.split()
    assert set(said) <= {"True"}
    return int(count)


@pytest.mark.skipif(platform.libc_ver()[0] != "glibc", reason="another C library")
def test_steps_that_free_a_model_cost_no_page_faults():
    assert faults("", 20, 16, 5) > 10_000
    assert faults("growing", 20, 16, 5) < 100
    assert faults("of one size", 20, 16, 5) < 100


@pytest.mark.skipif(platform.libc_ver()[0] != "glibc", reason="another C library")
def test_blocks_of_more_than_32_mib_go_back_where_a_model_grows():
    assert faults("growing", 40, 3) > 10_000
    assert faults("of one size, growing", 40, 3) > 10_000
    assert faults("of one size", 40, 3) < 100


@pytest.mark.timeout(20)
@pytest.mark.parametrize("size", [2**62, 2**63 + 1, 2**64 - 1])
def test_memory_that_nobody_has_is_refused(library, size):
    calls = library.calls
    workspace = calls.fragprune_workspace_new()
    try:
        assert not calls.fragprune_workspace_take(workspace, size)
    finally:
        calls.fragprune_workspace_free(workspace)
