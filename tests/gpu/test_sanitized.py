"""The kernels, emulated, under sanitizers; and that these see what is planted for them."""

import subprocess
import sys
from pathlib import Path

import pytest
from gpu import sanitized

from fragprune_plugins.workbench.doctor.emulated import EmulatedDevice

pytestmark = [pytest.mark.slow, pytest.mark.timeout(1800)]


@pytest.fixture
def run(device: EmulatedDevice):
    """Runs the command; its exit status and what it said."""

    def command(kind: str, *arguments: str) -> tuple[int, str]:
        if sanitized.library(device.compiler, kind) is None:
            pytest.skip(f"{device.compiler} has no sanitizer of {kind}")
        done = subprocess.run(
            [sys.executable, "-m", "gpu.sanitized", kind, *arguments],
            cwd=Path(__file__).parents[1],
            capture_output=True,
            text=True,
        )
        return done.returncode, done.stdout + done.stderr

    return command


@pytest.mark.parametrize(
    ("kind", "resident"), [("thread", 1), ("thread", 3), ("address", 3), ("undefined", 3)]
)
def test_all_kernels_in_all_dialects_are_clean(run, kind, resident):
    status, said = run(kind, "--resident", str(resident))
    assert status == 0, said[-6000:]
    assert f"seed {len(sanitized.DIALECTS) - 1}" in said


@pytest.mark.parametrize(
    ("kind", "kernel", "said"),
    [
        ("thread", "fp_no_barrier", "data race"),
        ("thread", "fp_ballot_for_fence", "data race"),
        ("thread", "fp_flag_without_fence", "data race"),
        ("address", "fp_beyond_its_shared_memory", "global-buffer-overflow"),
        ("address", "fp_beyond_its_array", "use-after-poison"),
        ("undefined", "fp_shifts_too_far", "shift exponent"),
        ("thread", "fp_with_barrier", ""),
        ("thread", "fp_syncwarp", ""),
        ("thread", "fp_number_is_flag", ""),
        ("address", "fp_with_barrier", ""),
        ("undefined", "fp_with_barrier", ""),
    ],
)
def test_a_planted_fault_is_seen_and_the_right_way_not_taken_for_one(run, kind, kernel, said):
    status, heard = run(kind, "--broken", kernel)
    assert (status != 0) == bool(said), heard[-6000:]
    assert said in heard
