from __future__ import annotations

import pytest

from fragprune_plugins.workbench.demo.scene import make_scene


@pytest.fixture(autouse=True)
def _one_thread(single_thread):
    """Bit-identical runs need sums in one order."""


@pytest.fixture(scope="session")
def photographs(tmp_path_factory):
    """The demo's room, very small."""
    folder = tmp_path_factory.mktemp("scene")
    make_scene(folder, views=6, width=40, points=150)
    return folder
