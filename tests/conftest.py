"""What every room of the suite shares: one torch thread, calm Hypothesis, fresh processes."""

import gc
import json
import os
import signal
import subprocess
import sys
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest
from hypothesis import HealthCheck, settings

pytest_plugins = ["fragprune_plugins.testing.plugin"]

settings.register_profile(
    "fragprune",
    deadline=None,  # a first call may build or import something
    derandomize=True,
    max_examples=30,
    suppress_health_check=[HealthCheck.too_slow, HealthCheck.function_scoped_fixture],
)
settings.load_profile("fragprune")

os.environ["OMP_NUM_THREADS"] = "1"
for _variable in ("FRAGPRUNE_BLOCK", "FRAGPRUNE_ONLY"):
    os.environ.pop(_variable, None)


@pytest.fixture(autouse=True)
def _frozen():
    """What there is needs no further collection: every run of a host ends in full ones."""
    gc.collect()
    gc.freeze()


@pytest.fixture(autouse=True)
def _one_thread():
    """Torch on one: the same sums in the same order, and no thread that a forked process misses."""
    yield
    if torch := sys.modules.get("torch"):
        torch.set_num_threads(1)  # whatever the test asked for


@pytest.fixture(scope="session", autouse=True)
def _without_waiting_for_the_disk():
    """Only a power cut would lose what the system has not written yet."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(os, "fsync", lambda _: None)
        yield


@pytest.fixture
def tmp_path(tmp_path: Path) -> Path:
    """A folder alone in its folder: a run whose host is unknown reads the one above, too."""
    folder = tmp_path / "alone"
    folder.mkdir()
    return folder


@pytest.fixture(scope="session")
def photographs(tmp_path_factory):
    """The demo's room, very small."""
    from fragprune_plugins.workbench.demo.scene import make_scene

    folder = tmp_path_factory.mktemp("scene")
    make_scene(folder, views=6, width=40, points=150)
    return folder


@pytest.fixture
def ctrl_c():
    """SIGINT as at a terminal: a job in the background is started with it ignored."""
    before = signal.signal(signal.SIGINT, signal.default_int_handler)
    yield
    signal.signal(signal.SIGINT, before)


@pytest.fixture
def plug() -> Iterator[Callable[..., None]]:
    """Register plugins in this process, for the length of a test."""
    from fragprune_plugins.plugins.loading import installed

    def register(plugin: object, name: str = "mine") -> None:
        installed().register(plugin, name)

    installed.cache_clear()
    yield register
    installed.cache_clear()


@pytest.fixture
def python(tmp_path: Path) -> Callable[..., Any]:
    """Run code in a fresh interpreter; what it prints last, as JSON."""

    def run(code: str, *arguments: object, path: str | Path | None = None) -> Any:
        environment = dict(os.environ)
        if path is not None:
            before = (str(path), os.environ.get("PYTHONPATH", ""))
            environment["PYTHONPATH"] = os.pathsep.join(filter(None, before))
        done = subprocess.run(
            [sys.executable, "-c", code, *map(str, arguments)],
            capture_output=True,
            text=True,
            cwd=tmp_path,
            env=environment,
            timeout=240,
        )
        assert done.returncode == 0, done.stderr[-4000:]
        lines = done.stdout.strip().splitlines()
        return json.loads(lines[-1]) if lines else None

    return run
