"""One library and engine per build that runs on this machine."""

import pytest
from native.sanitize import building

from fragprune_plugins.engines.cpu import binding
from fragprune_plugins.engines.cpu.engine import CpuEngine


@pytest.fixture(params=binding.usable_builds(), scope="session")
def library(request: pytest.FixtureRequest) -> binding.Library:
    """The compiled code, once per build."""
    return binding.open_build(request.param)


@pytest.fixture(scope="session")
def engine(library: binding.Library) -> CpuEngine:
    """The cpu engine, likewise."""
    return CpuEngine(library)


@pytest.fixture(scope="session")
def toolchain(tmp_path_factory: pytest.TempPathFactory) -> building.Toolchain:
    """A C++ compiler; skips where there is none."""
    compiler = building.find_compiler()
    if compiler is None:
        pytest.skip("no C++ compiler here")
    return building.Toolchain(compiler, tmp_path_factory.mktemp("sanitize"))
