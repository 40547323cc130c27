"""A small scene in files: photographs, and a model that is a little off."""

import pytest
from finetune import tiny

from fragprune_plugins.workbench.models.formats.ply import write_ply


@pytest.fixture
def _written(tmp_path):
    return tiny.scene(tmp_path)


@pytest.fixture
def data(_written):
    """The folder of photographs."""
    return _written[0]


@pytest.fixture
def path(_written):
    """The file of the model."""
    return _written[1]


@pytest.fixture
def model(_written):
    return _written[2]


@pytest.fixture
def cut(path, model):
    """The file of the model, which now has thresholds."""
    write_ply(path, tiny.cut(model, 0.3))
    return path


@pytest.fixture
def out(tmp_path):
    """Where a new model is to be written."""
    return tmp_path / "out.ply"


@pytest.fixture
def words(data, path, out):
    """A fine-tuning of the model on the photographs, but for how long."""
    return "finetune", path, "--data", data, "--out", out, "--iters"


@pytest.fixture
def tuning(data, path):
    """Twenty steps of it, to be written anywhere, and further options."""
    return lambda out, *more: ("finetune", path, "--data", data, "--out", out, "--iters", 20, *more)
