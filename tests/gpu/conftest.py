"""The kernels' own sources, emulated; and what else the tests of a GPU's engine share."""

import os
import shutil
from importlib.metadata import distributions
from pathlib import Path

import pytest

from fragprune_plugins.engines.cuda import kernels
from fragprune_plugins.engines.cuda.engine import CudaEngine
from fragprune_plugins.workbench.doctor.emulated import EmulatedDevice


@pytest.fixture(scope="session")
def device(tmp_path_factory: pytest.TempPathFactory) -> EmulatedDevice:
    """One for all tests: each set of macros is built once. Skips where there is no g++."""
    folder = tmp_path_factory.getbasetemp()
    if "PYTEST_XDIST_WORKER" in os.environ:
        folder = folder.parent  # of all workers
    compiler = shutil.which("g++")
    if compiler is None:
        pytest.skip("no g++ here")
    (folder / "emulated").mkdir(exist_ok=True)
    return EmulatedDevice(compiler, folder / "emulated")


@pytest.fixture(autouse=True)
def _little_room(request: pytest.FixtureRequest, monkeypatch: pytest.MonkeyPatch) -> None:
    """An emulated sort of a million entries takes a second; what does not fit is drawn again."""
    if not request.node.get_closest_marker("gpu"):
        monkeypatch.setattr(CudaEngine, "capacity", 1 << 13)


@pytest.fixture
def engine(device: EmulatedDevice) -> CudaEngine:
    """The engine, on the emulated device."""
    return CudaEngine(device, deterministic=False)


@pytest.fixture
def kept(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """An empty folder for compiled kernels."""
    monkeypatch.setenv(kernels.CACHE, str(tmp_path / "kept"))
    return tmp_path / "kept"


@pytest.fixture(scope="session")
def nvrtc() -> kernels.Nvrtc:
    """What the development extra brings on Linux must be there then; tests alone do not need it."""
    try:
        return kernels.Nvrtc()
    except kernels.Unavailable as why:
        if {"nvidia-cuda-nvrtc", "cuda-bindings"} & {each.name for each in distributions()}:
            raise
        pytest.skip(str(why))
