"""One engine per build that runs on this machine."""

from __future__ import annotations

import pytest

from fragprune_plugins.engines.cpu import CpuEngine
from fragprune_plugins.native import loader


@pytest.fixture(params=loader.usable_builds(), scope="session")
def engine(request: pytest.FixtureRequest) -> CpuEngine:
    """The cpu engine, once per build."""
    return CpuEngine(loader.open_build(request.param))
