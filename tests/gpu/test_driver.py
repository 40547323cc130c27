"""The calls of CUDA's driver, through the real bindings, taken by a libcuda that emulates a GPU.

Proves what is packed and passed to the driver, and in which order; not that a GPU likes it.
"""

import os
import subprocess
import sys
from pathlib import Path

import pytest
import scenes
import torch
from native.test_invariants import everything

from fragprune_plugins.engines.cuda import kernels
from fragprune_plugins.engines.cuda.engine import CudaEngine
from fragprune_plugins.workbench.doctor.emulated import EmulatedDevice

BEGIN = """
import os
import sys
from contextlib import contextmanager
from types import SimpleNamespace

import torch
from cuda.bindings import driver as cu
from native.test_invariants import assert_identical, everything

from fragprune_plugins.engines import create_engine
from fragprune_plugins.engines.cuda import self_check
from fragprune_plugins.engines.cuda.engine import CudaEngine
from fragprune_plugins.engines.cuda.driver import Driver
from fragprune_plugins.errors import EngineError
import scenes

asked = []


@contextmanager
def device(where):
    asked.append(where)
    yield


torch.cuda.device = device
torch.cuda.is_available = lambda: True
torch.cuda.init = lambda: None
torch.cuda.current_device = lambda: 0
torch.cuda.current_stream = lambda index: SimpleNamespace(cuda_stream=0)
torch.cuda.get_device_capability = lambda index: (9, 0)
Driver.kind = "cpu"

expected = torch.load(sys.argv[1])
inputs, thresholds = scenes.random_scene(0), scenes.random_thresholds(0, 60)
"""

BOTH_KINDS_OF_CODE = """
self_check.why_not = lambda device: None
assert create_engine("auto", "cuda").name == "cuda"
assert_identical(expected, everything(CudaEngine(deterministic=True), inputs, thresholds))
assert CudaEngine().device is CudaEngine().device
os.environ["FAKE_REFUSES"] = "machine code"
anew = CudaEngine(Driver(), deterministic=True)
assert_identical(expected, everything(anew, inputs, thresholds))
os.environ["FRAGPRUNE_CUDA"] = "off"
try:
    CudaEngine()
except EngineError as error:
    assert "switched off" in error.found, error
else:
    raise AssertionError
"""

ANOTHER_GPU = """
class Second(Driver):  # tensors are the CPU's, whichever GPU draws them
    def launch(self, where, *kernel):
        super().launch(torch.device("cuda", 1), *kernel)


def current():
    status, context = cu.cuCtxGetCurrent()
    return int(context)


cu.cuInit(0)
torchs = cu.cuDevicePrimaryCtxRetain(0)[1]
cu.cuCtxSetCurrent(torchs)
assert_identical(expected, everything(CudaEngine(Second(), deterministic=True), inputs, thresholds))
assert current() == int(torchs) != int(cu.cuDevicePrimaryCtxRetain(1)[1])
assert cu.cuCtxPopCurrent()[0] == 0
assert int(cu.cuCtxPopCurrent()[0]) != 0  # and nothing else was left on the stack
"""

AN_EARLIER_KERNEL_FAILED = """
os.environ["FAKE_FAILED"] = "1"
try:
    CudaEngine().rasterize(inputs, thresholds)
except EngineError as error:
    assert type(error) is EngineError and "ILLEGAL_ADDRESS" in error.found, error
else:
    raise AssertionError
"""


@pytest.fixture(scope="module")
def script(device, nvrtc, tmp_path_factory):
    """Runs a script where libcuda is the stand-in; what it says."""
    if not sys.platform.startswith("linux"):
        pytest.skip("needs dlopen and ELF")
    here, folder = Path(__file__).parent, tmp_path_factory.mktemp("driver")
    builds = folder / "builds"
    builds.mkdir()
    alone = EmulatedDevice(device.compiler, builds)
    engine = CudaEngine(alone, deterministic=True)
    inputs, thresholds = scenes.random_scene(0), scenes.random_thresholds(0, 60)
    torch.save(everything(engine, inputs, thresholds), folder / "expected")
    fake = folder / "libcuda.so.1"
    command = [device.compiler, "-std=c++17", "-fPIC", "-shared", "-o", str(fake)]
    subprocess.run([*command, str(here / "fake_driver.cpp"), "-ldl"], check=True)
    environment = {
        "PYTHONPATH": str(here.parent),
        "LD_LIBRARY_PATH": str(folder),
        "FAKE_KERNELS": str(builds),
        kernels.CACHE: str(folder / "kept"),
    }
    # Compiled here, found there: NVRTC itself looks for a driver, and must not meet this one.
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv(kernels.CACHE, environment[kernels.CACHE])
        for source, macros in alone.opened:
            for target in ("sm_90", "compute_90"):
                kernels.image_of(source, dict(macros), target, nvrtc)

    def run(code: str) -> str:
        done = subprocess.run(
            [sys.executable, "-c", BEGIN + code, str(folder / "expected")],
            capture_output=True,
            text=True,
            env={**os.environ, **environment},
        )
        assert done.returncode == 0, done.stderr[-3000:]
        return done.stderr

    return run


def test_the_driver_is_asked_for_what_the_emulation_does(script):
    """And drawing on another GPU leaves the current one; one test, for its kernels take long."""
    said = script(BOTH_KINDS_OF_CODE)
    assert "fp_blend from machine code" in said
    assert "fp_chain from PTX" in said
    script(ANOTHER_GPU)


def test_what_an_earlier_kernel_did_is_not_put_on_the_code_of_the_next(script):
    """A failed kernel fails every later call, so loading code would seem to be refused."""
    script(AN_EARLIER_KERNEL_FAILED)
