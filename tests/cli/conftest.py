import pytest
from finetune import tiny

from fragprune_plugins.workbench.models.formats.ply import write_ply


@pytest.fixture
def scene(tmp_path):
    """Photographs and a model of them; processes that are forked must not inherit threads."""
    data, path, _ = tiny.scene(tmp_path)
    return data, path


@pytest.fixture
def cut_scene(tmp_path):
    """Photographs and a model of them with thresholds."""
    data, path, model = tiny.scene(tmp_path)
    write_ply(path, tiny.cut(model, 0.3))
    return data, path
