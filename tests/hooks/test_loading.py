"""Plugins are found, blocked, loaded one by one and checked; none stops another."""

import logging
from types import SimpleNamespace

import pytest

from fragprune_plugins.adapting import HostAdapter, hookimpl
from fragprune_plugins.errors import PluginError
from fragprune_plugins.plugins import hookspecs, loading
from fragprune_plugins.plugins.loading import Plugins, installed, load_plugins
from fragprune_vanilla_3dgs import Vanilla3DGS

HOOKS = [getattr(hookspecs, name) for name in vars(hookspecs) if name.startswith("fragprune_")]


class Entry:
    """An installed entry point; ``plugin`` may be an exception to raise on import."""

    def __init__(self, name, plugin, value=None):
        self.name, self.plugin, self.value = name, plugin, value or f"{name}_module"
        self.loads = 0

    def load(self):
        self.loads += 1
        if isinstance(self.plugin, BaseException):
            raise self.plugin
        return self.plugin


def adapter(name):
    return type("Fork", (Vanilla3DGS,), {"name": name})()


GOOD = Entry("good", adapter("good-host"))


def codes(plugins):
    return [(finding.level, finding.code) for finding in plugins.findings]


def names(plugins):
    return [adapter.name for adapter in plugins.adapters]


MISSPELT = SimpleNamespace(fragprune_trunkate=hookimpl(lambda inputs, store: None))
"""There is no such hook."""


class Broken(Vanilla3DGS):
    def __init__(self):
        raise RuntimeError("my table is missing")


@hookimpl(wrapper=True)
def wrapper(inputs, store):
    return (yield)


FAULTS = {
    "import fails": (ImportError("libfancy.so is missing"), "ImportError: libfancy.so is missing"),
    "import raises": (ZeroDivisionError("at import"), "ZeroDivisionError"),
    "import exits": (SystemExit(7), "SystemExit: 7"),
    "misspelt hook": (MISSPELT, "fragprune_trunkate"),
    "no hooks": (logging, "no hooks"),  # where an older installation names a module
    "unknown argument": (
        SimpleNamespace(fragprune_truncate=hookimpl(lambda inputs, tau: None)),
        "tau",
    ),
    "adapter raises": (Broken, "RuntimeError: my table is missing"),
    "adapter is abstract": (HostAdapter, "abstract class HostAdapter"),
    "wrapper": (SimpleNamespace(fragprune_truncate=wrapper), "fragprune_truncate is a wrapper"),
    "no name": (type("Nameless", (Vanilla3DGS,), {"name": None}), "has no name (str)"),
}


@pytest.mark.parametrize("order", ["before", "after"])
@pytest.mark.parametrize("fault", FAULTS)
def test_one_bad_plugin_is_reported_and_stops_no_other(fault, order):
    plugin, words = FAULTS[fault]
    bad = Entry("bad", plugin)
    plugins = load_plugins([bad, GOOD] if order == "before" else [GOOD, bad])
    assert names(plugins) == ["good-host"]
    assert codes(plugins) == [("error", "plugin-failed")]
    assert words in plugins.findings[0].found
    assert "bad = bad_module" in plugins.findings[0].where
    assert list(plugins.loaded) == ["good"]
    assert not any("bad" in plugins.answering(hook) for hook in HOOKS)


@pytest.mark.parametrize(
    ("variable", "value", "expected"),
    [
        ("FRAGPRUNE_BLOCK", "other", ["good-host"]),
        ("FRAGPRUNE_BLOCK", " other , good ", []),
        ("FRAGPRUNE_ONLY", "other", ["other-host"]),
        ("FRAGPRUNE_ONLY", "", ["good-host", "other-host"]),
    ],
)
def test_plugins_are_blocked_by_name_before_they_are_loaded(monkeypatch, variable, value, expected):
    monkeypatch.setenv(variable, value)
    entries = [Entry(name, adapter(f"{name}-host")) for name in ("good", "other")]
    plugins = load_plugins(entries)
    assert names(plugins) == expected
    assert sum(entry.loads for entry in entries) == len(expected)
    assert codes(plugins) == [("info", "plugin-blocked")] * (2 - len(expected))


def test_a_second_distribution_under_the_same_name_is_reported():
    twin = Entry("good", adapter("twin-host"), value="twin_module")
    plugins = load_plugins([GOOD, twin])
    assert names(plugins) == ["good-host"]
    assert codes(plugins) == [("warning", "plugin-shadowed")]
    assert "twin_module" in plugins.findings[0].where
    assert "good_module" in plugins.findings[0].found
    assert codes(load_plugins([GOOD, GOOD])) == []  # the same entry point listed twice


def test_an_adapter_offered_twice_is_reported():
    more = Entry("more", adapter("good-host")), Entry("other", adapter("a-host"))
    plugins = load_plugins([GOOD, *more])
    assert names(plugins) == ["a-host", "good-host"]
    assert codes(plugins) == [("warning", "adapter-shadowed")]
    assert plugins.findings[0].where == "adapter good-host of plugin more"
    assert "plugin good has one of this name" in plugins.findings[0].found


def test_a_plugin_that_is_refused_leaves_its_name_free():
    loaded = Plugins()
    with pytest.raises(PluginError, match="fragprune_trunkate"):
        loaded.register(MISSPELT, "mine")
    first = adapter("a-host")
    loaded.register(first, "mine")
    assert names(loaded) == ["a-host"]
    for second in (adapter("b-host"), first):
        with pytest.raises(PluginError, match="plugin mine: two plugins of this name"):
            loaded.register(second, "mine")
    with pytest.raises(PluginError, match="already registered under a different name"):
        loaded.register(first, "yours")
    assert names(loaded) == ["a-host"]


def test_an_adapter_may_have_hooks_too():
    class Chosen(Vanilla3DGS):
        name = "chosen"

        @hookimpl
        def fragprune_select_adapter(self, repo, matches):
            return self.name

    loaded = Plugins()
    loaded.register(Chosen, "mine")
    assert names(loaded) == ["chosen"]
    assert loaded.answering(hookspecs.fragprune_select_adapter) == ["mine"]


def test_plugins_are_found_once_in_a_process_and_faults_are_said(monkeypatch, caplog):
    looked = []

    def entries(group):
        looked.append(group)
        return [GOOD, Entry("bad", ImportError("libfancy.so is missing"))]

    monkeypatch.setattr(loading, "entry_points", entries)
    installed.cache_clear()
    try:
        with caplog.at_level(logging.WARNING, logger="fragprune"):
            assert names(installed()) == names(installed()) == ["good-host"]
    finally:
        installed.cache_clear()
    assert looked == [loading.GROUP]
    assert caplog.text.count("libfancy.so is missing") == 1


def test_what_is_installed_loads_without_findings():
    plugins = load_plugins()
    assert plugins.findings == []
    assert "vanilla-3dgs" in names(plugins)
    assert all(isinstance(adapter, HostAdapter) for adapter in plugins.adapters)
