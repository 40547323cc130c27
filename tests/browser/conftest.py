"""One Chromium for all tests of a worker."""

from collections.abc import Iterator
from typing import Any

import pytest
from browser import chromium


@pytest.fixture(scope="session")
def browser() -> Iterator[Any]:
    """Playwright's browser. Skips where there is none."""
    if reason := chromium.missing():
        pytest.skip(reason)
    with chromium.chromium() as started:
        yield started
