"""setup.py builds what the loader looks for, from every header there is."""

import re
import runpy
from pathlib import Path

import pytest

from fragprune_plugins.engines.cpu import binding

ROOT = Path(__file__).parents[2]


@pytest.fixture
def shipped(monkeypatch):
    monkeypatch.chdir(ROOT)  # where its paths begin
    return runpy.run_path("setup.py")


def test_every_build_that_the_loader_knows_is_built(shipped):
    assert set(shipped["BUILDS"]) == set(binding.BUILDS)


def test_a_change_to_any_header_that_the_engine_includes_rebuilds_it(shipped):
    sources = [shipped["SOURCE"], *shipped["HEADERS"]]
    text = "".join(path.read_text() for path in sources)
    included = set(re.findall(r'^#include "(?:.*/)?(\w+\.h)"', text, re.MULTILINE))
    assert included == {path.name for path in shipped["HEADERS"]}


def test_every_build_has_the_name_that_the_loader_opens(shipped):
    assert shipped["SUFFIX"] == binding._SUFFIX
