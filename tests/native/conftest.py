"""One engine per build that runs on this machine."""

import pytest
from native.sanitize import building

from fragprune_plugins.engines.cpu import binding
from fragprune_plugins.engines.cpu.engine import CpuEngine


@pytest.fixture(params=binding.usable_builds(), scope="session")
def engine(request: pytest.FixtureRequest) -> CpuEngine:
    """The cpu engine, once per build."""
    return CpuEngine(binding.open_build(request.param))


@pytest.fixture(scope="session")
def toolchain(tmp_path_factory: pytest.TempPathFactory) -> building.Toolchain:
    """A C++ compiler; skips where there is none."""
    compiler = building.find_compiler()
    if compiler is None:
        pytest.skip("no C++ compiler here")
    return building.Toolchain(compiler, tmp_path_factory.mktemp("sanitize"))
