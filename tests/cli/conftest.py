import pytest
from finetune import tiny


@pytest.fixture
def scene(tmp_path, single_thread):
    """Photographs and a model of them; processes that are forked must not inherit threads."""
    data, path, _ = tiny.scene(tmp_path)
    return data, path
