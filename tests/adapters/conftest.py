import pytest


@pytest.fixture(autouse=True)
def _one_thread(single_thread):
    """Bit-identical runs need sums in one order."""
