"""What a step frees is there for the next one, without the kernel."""

import platform
import subprocess
import sys

import pytest

STEPS = """
import ctypes, resource, sys
from fragprune_plugins.engines.cpu.memory import keep_freed_memory
if sys.argv[1] == "kept":
    print(keep_freed_memory())
libc, sizes = ctypes.CDLL(None), [20 << 20, 16 << 20, 5 << 20]
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


def faults(kind: str) -> int:
    done = subprocess.run(
        [sys.executable, "-c", STEPS, kind], capture_output=True, text=True, check=True
    )
    *said, count = done.stdout.split()
    assert said == (["True"] if kind == "kept" else [])
    return int(count)


@pytest.mark.skipif(platform.libc_ver()[0] != "glibc", reason="another C library")
def test_steps_that_free_a_model_cost_no_page_faults() -> None:
    assert faults("as it is") > 10_000
    assert faults("kept") < 100
