from typing import Any

import pytest
from conformance.relatives import RelativeConformance
from miniatures.changed import ForkHost

from fragprune_plugins.testing.plugin import NOT_APPLICABLE


class TestFork(RelativeConformance):
    adapter = "3dgs-fork"
    host = ForkHost

    def test_alignment(self, case: Any, check: Any) -> None:
        pytest.skip(f"{NOT_APPLICABLE}a row that is added begins neutral, whatever its parent has")

    def test_refuse(self, case: Any, check: Any) -> None:
        pytest.skip(f"{NOT_APPLICABLE}it reads signatures: what it refuses, core/test_forks says")
