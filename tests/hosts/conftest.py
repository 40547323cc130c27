from __future__ import annotations

import os
import shutil
from pathlib import Path

import pytest

from fragprune_plugins.demo.scene import SceneSettings, make_scene


@pytest.fixture(scope="session")
def dataset(tmp_path_factory):
    """A copy: hosts write into the data they are given."""
    given, target = os.environ.get("FRAGPRUNE_TEST_DATA"), tmp_path_factory.mktemp("data") / "scene"
    candidates = [Path(given) / "fox" / "colmap160", Path(given)] if given else []
    for candidate in candidates:
        if (candidate / "sparse").is_dir():
            shutil.copytree(candidate, target)
            return target
    make_scene(target, SceneSettings(views=12, width=80, height=60, supersample=1, points=600))
    return target
