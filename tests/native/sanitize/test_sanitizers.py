"""The engine under sanitizers: random calls of the C interface, two at once, memory running out.

``driver.cpp`` says what is called and ``calls.h`` what must hold after each call; a failure prints
the seed in hand. For a longer run see docs/how-to/sanitize.md.
"""

import pytest
from native.sanitize.building import MEMORY, THREADS, builds

pytestmark = pytest.mark.slow


@pytest.mark.parametrize("build", builds())
def test_no_access_out_of_bounds_no_leak_nothing_undefined(toolchain, build):
    tally = toolchain.tally("sanitize/driver.cpp", build, MEMORY, 0, 1500)
    assert tally["calls"] == 1500
    # The dice left nothing out: an engine that draws nothing would pass without a word.
    for kind in ("drew", "poisoned", "backward", "refused", "empty", "cut", "present", "losses"):
        assert tally[kind] > 50, kind


def test_no_race(toolchain):
    tally = toolchain.tally("sanitize/driver.cpp", "baseline", THREADS, 0, 400)
    assert tally["drew"] > 100
    assert tally["backward"] > 100
