"""The calls of CUDA's driver, through the real bindings, taken by a libcuda that emulates a GPU.

Proves what is packed and passed to the driver, and in which order; not that a GPU likes it.
"""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import pytest
import torch
from gpu.emulated import EmulatedDevice
from gpu.test_compile import nvrtc
from native.test_invariants import everything

from fragprune_plugins.engines.cuda import kernels
from fragprune_plugins.engines.cuda.engine import CudaEngine
from fragprune_plugins.testing import scenes

__all__ = ["nvrtc"]

SCRIPT = """
import os
import sys
from types import SimpleNamespace

import torch
from native.test_invariants import assert_identical, everything

from fragprune_plugins.engines import create_engine
from fragprune_plugins.engines.cuda import self_check
from fragprune_plugins.engines.cuda.engine import CudaEngine
from fragprune_plugins.engines.cuda.driver import Driver
from fragprune_plugins.testing import scenes

torch.cuda.is_available = lambda: True
torch.cuda.init = lambda: None
torch.cuda.current_device = lambda: 0
torch.cuda.current_stream = lambda index: SimpleNamespace(cuda_stream=0)
torch.cuda.get_device_capability = lambda index: (9, 0)
torch.cuda.is_current_stream_capturing = lambda: False
Driver.kind = "cpu"
self_check.doubt = lambda: None
assert create_engine("auto", "cuda").name == "cuda"

expected = torch.load(sys.argv[1])
inputs, thresholds = scenes.random_scene(0), scenes.random_thresholds(0, 60)
assert_identical(expected, everything(CudaEngine(deterministic=True), inputs, thresholds))
os.environ["FAKE_REFUSES"] = "machine code"
assert_identical(expected, everything(CudaEngine(deterministic=True), inputs, thresholds))
"""


@pytest.mark.skipif(not sys.platform.startswith("linux"), reason="needs dlopen and ELF")
def test_the_driver_is_asked_for_what_the_emulation_does(
    device: EmulatedDevice, nvrtc: kernels.Nvrtc, kept: Path, tmp_path: Path
) -> None:
    here, builds = Path(__file__).parent, tmp_path / "builds"
    builds.mkdir()
    alone = EmulatedDevice(device.compiler, builds)
    engine = CudaEngine(alone, deterministic=True)
    inputs, thresholds = scenes.random_scene(0), scenes.random_thresholds(0, 60)
    torch.save(everything(engine, inputs, thresholds), tmp_path / "expected")
    # Compiled here, found there: NVRTC itself looks for a driver, and must not meet this one.
    for source, macros in alone.opened:
        for target in ("sm_90", "compute_90"):
            kernels.image_of(source, dict(macros), target, nvrtc)
    fake = tmp_path / "libcuda.so.1"
    command = [device.compiler, "-std=c++17", "-fPIC", "-shared", "-o", str(fake)]
    subprocess.run([*command, str(here / "fake_driver.cpp"), "-ldl"], check=True)
    done = subprocess.run(
        [sys.executable, "-c", SCRIPT, str(tmp_path / "expected")],
        capture_output=True,
        text=True,
        env={
            **os.environ,
            "PYTHONPATH": str(here.parent),
            "LD_LIBRARY_PATH": str(tmp_path),
            "FAKE_KERNELS": str(builds),
            kernels.ENVIRONMENT: "nvrtc",
        },
    )
    assert done.returncode == 0, done.stderr[-3000:]
    assert "fp_blend from machine code" in done.stderr
    assert "fp_chain from PTX" in done.stderr
