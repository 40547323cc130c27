from contextlib import contextmanager
from importlib.util import find_spec

import pytest
from installed.gaussian_splatting_host import GaussianSplattingHost
from installed.gsplat_host import GsplatHost

from fragprune_plugins.hosts.source import HostRepo
from fragprune_plugins.testing.host import running

DRIVERS = {"gaussian-splatting": GaussianSplattingHost, "gsplat": GsplatHost}


@pytest.fixture
def session_on():
    """``session_on(adapter, settings)``: the installed host under a session, its modules fresh.

    ``path`` is another folder that holds the host's package.
    """

    @contextmanager
    def begin(adapter, settings=None, path=None, **options):
        driver = DRIVERS[adapter.name]()
        path = path or HostRepo.installed(driver.package).root
        with running(settings, adapter=adapter, path=path, driver=driver, **options) as host:
            yield host.session

    return begin


def pytest_ignore_collect(collection_path):
    """Where a host is not installed there is nothing to test it with."""
    needs = {"test_gaussian_splatting.py": "gaussian_splatting"}
    package = needs.get(collection_path.name, "gsplat")
    return True if package and find_spec(package) is None else None
