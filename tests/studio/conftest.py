from importlib.util import find_spec

import pytest

from fragprune_plugins.workbench.demo.scene import make_scene


def pytest_collection_modifyitems(items):
    """Where nerfstudio is absent its tests say so."""
    if find_spec("nerfstudio") is None:
        for item in items:
            if item.get_closest_marker("nerfstudio"):
                item.add_marker(pytest.mark.skip("nerfstudio is not installed"))


@pytest.fixture(scope="session")
def scene(tmp_path_factory):
    """The demo's room as COLMAP text, small."""
    folder = tmp_path_factory.mktemp("scene")
    make_scene(folder, views=16, width=64, points=400)
    return folder
