"""Memory that no machine has is refused, neither waited for nor rounded down to something small."""

import pytest

from fragprune_plugins.engines.cpu import binding


@pytest.mark.timeout(20)
@pytest.mark.parametrize("size", [2**62, 2**63 + 1, 2**64 - 1])
@pytest.mark.parametrize("build", binding.usable_builds())
def test_memory_that_nobody_has_is_refused(build, size):
    calls = binding.open_build(build).calls
    workspace = calls.fragprune_workspace_new()
    try:
        assert not calls.fragprune_workspace_take(workspace, size)
    finally:
        calls.fragprune_workspace_free(workspace)
