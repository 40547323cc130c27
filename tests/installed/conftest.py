from __future__ import annotations

import sys
from contextlib import contextmanager
from importlib.util import find_spec

import pytest

from fragprune_plugins.demo.scene import SceneSettings, make_scene
from fragprune_plugins.hosts.source import HostRepo
from fragprune_plugins.injection.cpu_only import cpu_only
from fragprune_plugins.injection.launch import _forget_modules
from fragprune_plugins.injection.session import Session
from fragprune_plugins.learning.schedule import JointSchedule, Settings
from fragprune_plugins.plugins.loading import load_plugins


@pytest.fixture(autouse=True)
def _one_thread(single_thread):
    """Bit-identical runs need sums in one order."""


@pytest.fixture(scope="session")
def photographs(tmp_path_factory):
    """The demo's room, very small."""
    folder = tmp_path_factory.mktemp("scene")
    make_scene(folder, SceneSettings(views=6, width=40, height=30, supersample=1, points=150))
    return folder


@pytest.fixture
def session_on(request):
    """``session_on(adapter, ...)``: the installed host under a session, its modules fresh."""

    @contextmanager
    def running(adapter, **options):
        package = adapter.installed[0]
        repo, known = HostRepo.installed(package), set(sys.modules)
        session = Session(adapter, repo, load_plugins(), drop_in=True, **options)
        try:
            with cpu_only(), session:
                yield session
        finally:
            _forget_modules(repo.root, known, adapter.installed)

    return running


@pytest.fixture
def unmoved(session_on):
    """As ``session_on``, for a joint run whose thresholds never move: rows alone change them."""

    def running(adapter):
        settings = Settings()
        schedule = JointSchedule(settings, from_step=10**9)
        return session_on(adapter, settings=settings, schedule=schedule, freeze=False)

    return running


def pytest_ignore_collect(collection_path):
    """Where a host is not installed there is nothing to test it with."""
    needs = {"test_gaussian_splatting.py": "gaussian_splatting", "test_gsplat.py": "gsplat"}
    package = needs.get(collection_path.name)
    return True if package and find_spec(package) is None else None
