"""Every adapter says what it serves and what it refuses."""

import pytest
from cli.commands import run_json

from fragprune_plugins.plugins.loading import load_plugins

ADAPTERS = load_plugins().adapters


@pytest.mark.parametrize("adapter", ADAPTERS, ids=lambda adapter: adapter.name)
def test_every_adapter_says_what_it_is_for(adapter):
    assert adapter.info.title
    assert adapter.info.repo.count("/") == 1
    assert adapter.info.states
    for limit in adapter.info.limits:
        assert limit.endswith(".")
        assert "\n" not in limit


def test_scripts_and_limits_are_data_too():
    (vanilla,) = (a for a in run_json("adapters")["adapters"] if a["name"] == "vanilla-3dgs")
    assert vanilla["scripts"] == ["train.py"]
    assert vanilla["limits"]
