"""A tiny model that is to be learned again from its pictures."""

import pytest
from finetune import tiny


@pytest.fixture(scope="session")
def truth():
    return tiny.random_model()


@pytest.fixture(scope="module")
def model(truth):
    return tiny.perturbed(truth)


@pytest.fixture(scope="module")
def dataset(truth, tmp_path_factory):
    return tiny.dataset_in_memory(tmp_path_factory.mktemp("images"), truth)


@pytest.fixture(scope="session")
def images(truth):
    return tiny.photographs(truth)


@pytest.fixture
def colmap(tmp_path, images):
    """COLMAP's folder of those pictures."""
    return tiny.write_colmap(tmp_path, images)
