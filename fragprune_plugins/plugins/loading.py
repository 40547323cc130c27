"""The plugin manager: entry points found, blocked, loaded one by one, and checked.

One plugin that fails to import never stops the others; it is reported. Environment:
``FRAGPRUNE_BLOCK`` and ``FRAGPRUNE_ONLY`` take comma-separated entry-point names.
"""

from __future__ import annotations

import os
from collections.abc import Iterable
from dataclasses import dataclass, field
from importlib.metadata import EntryPoint, entry_points

import pluggy

from fragprune_plugins.hosts.adapter import HostAdapter
from fragprune_plugins.hosts.findings import Finding
from fragprune_plugins.plugins import builtin, hookspecs

GROUP = "fragprune"


@dataclass
class Plugins:
    """Loaded plugins, the adapters they offer, and what went wrong on the way."""

    manager: pluggy.PluginManager
    adapters: list[HostAdapter] = field(default_factory=list)
    findings: list[Finding] = field(default_factory=list)
    loaded: dict[str, str] = field(default_factory=dict)  # entry point -> its value


def load_plugins(found: Iterable[EntryPoint] | None = None) -> Plugins:
    """Load every allowed entry point of the group ``fragprune``, each alone.

    Args:
        found: entry points to use in place of the installed ones.
    """
    manager = pluggy.PluginManager(hookspecs.PROJECT)
    manager.add_hookspecs(hookspecs)
    manager.register(builtin, "builtin")
    plugins = Plugins(manager)
    only = _names("FRAGPRUNE_ONLY")
    blocked = _names("FRAGPRUNE_BLOCK")
    for entry in entry_points(group=GROUP) if found is None else found:
        where = f"entry point {entry.name} = {entry.value}"
        if entry.name in blocked or (only and entry.name not in only):
            plugins.findings.append(Finding("info", "plugin-blocked", where, "blocked by name"))
        elif entry.name in plugins.loaded:
            if entry.value != plugins.loaded[entry.name]:
                plugins.findings.append(
                    Finding(
                        "warning",
                        "plugin-shadowed",
                        where,
                        f"the name is taken by {plugins.loaded[entry.name]}",
                        "one plugin per name",
                        "Uninstall one of the two distributions.",
                    )
                )
        else:
            _load(plugins, entry, where)
    plugins.adapters.sort(key=lambda adapter: adapter.name)
    return plugins


def _load(plugins: Plugins, entry: EntryPoint, where: str) -> None:
    """Load one plugin and take its adapters, or none of it."""
    manager = plugins.manager
    offered: list[HostAdapter] = []
    try:
        plugin = entry.load()
        manager.register(plugin, entry.name)
        try:
            manager.check_pending()
            others = [other for other in manager.get_plugins() if other is not plugin]
            hook = manager.subset_hook_caller("fragprune_register_adapters", others)
            hook(register=offered.append)
        except Exception:
            manager.unregister(plugin)
            raise
    except Exception as error:  # whatever a plugin raises is its own; the others go on
        plugins.findings.append(
            Finding(
                "error",
                "plugin-failed",
                where,
                f"{type(error).__name__}: {error}",
                "a module that imports and implements known hooks",
                "Fix or uninstall it, or set FRAGPRUNE_BLOCK.",
            )
        )
    else:
        plugins.loaded[entry.name] = entry.value
        for adapter in offered:
            _take(plugins, adapter)


def _take(plugins: Plugins, adapter: HostAdapter) -> None:
    if any(other.name == adapter.name for other in plugins.adapters):
        plugins.findings.append(
            Finding(
                "warning",
                "adapter-shadowed",
                f"adapter {adapter.name}",
                "offered twice; the first one is used",
                "one adapter per name",
                "Block one of the plugins.",
            )
        )
    else:
        plugins.adapters.append(adapter)


def _names(variable: str) -> set[str]:
    return {name.strip() for name in os.environ.get(variable, "").split(",") if name.strip()}
