"""Finds, blocks, loads and asks the plugins of this process, one by one.

A plugin that fails never stops the others. A failure at import becomes a finding; one in a hook is
an error that names the plugin. For that, pluggy collects and checks the hooks, and we call each
ourselves. So wrappers are refused.

Environment: ``FRAGPRUNE_BLOCK`` and ``FRAGPRUNE_ONLY`` take comma-separated entry-point names.
"""

from __future__ import annotations

import os
import traceback
from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass, field
from functools import cache
from importlib.metadata import EntryPoint, entry_points
from pathlib import Path
from typing import TYPE_CHECKING, Any

import pluggy

from fragprune_plugins.errors import PluginError, log
from fragprune_plugins.hosts.adapter import HostAdapter, HostInfo
from fragprune_plugins.hosts.findings import Finding
from fragprune_plugins.plugins import hookspecs

if TYPE_CHECKING:
    import torch

    from fragprune_plugins.engines import Engine

GROUP = "fragprune"

Hook = Callable[..., Any]  # a function of ``hookspecs``; its name is the hook's
Wrong = tuple[str, str]  # what was found in an answer, and what was expected
_FAULTS = (Exception, SystemExit)  # a plugin may raise these; Ctrl-C is the user's


class _Manager(pluggy.PluginManager):
    """Finds the hooks of adapters fast: each has some eighty names, and few have a hook."""

    def __init__(self) -> None:
        super().__init__(hookspecs.PROJECT)
        self.add_hookspecs(hookspecs)

    def parse_hookimpl_opts(self, plugin: Any, name: str) -> Any:
        """The options of a hook; None for what is not marked as one."""
        if isinstance(plugin, HostAdapter):
            holders = (plugin, *type(plugin).__mro__)
            found = next((vars(each)[name] for each in holders if name in vars(each)), None)
            both = (found, getattr(found, "__func__", None))
            if not any(hasattr(each, f"{self.project_name}_impl") for each in both):
                return None
        return super().parse_hookimpl_opts(plugin, name)


@dataclass
class Plugins:
    """Registered plugins, the adapters that they offer, and findings about failed plugins."""

    adapters: list[HostAdapter] = field(default_factory=list)
    findings: list[Finding] = field(default_factory=list)  # also of blocked and shadowed ones
    loaded: dict[str, str] = field(default_factory=dict)  # values of entry points by name
    # by requested name and device; an engine keeps memory and kernels for its next frame
    engines: dict[tuple[str, torch.device], Engine] = field(default_factory=dict)
    _manager: pluggy.PluginManager = field(default_factory=_Manager, init=False, repr=False)
    # (plugin, hook) of observers that raised
    _off: set[tuple[str, str]] = field(default_factory=set, init=False, repr=False)

    def register(self, plugin: object, name: str) -> None:
        """Register a plugin; if it fails, register nothing of it.

        Args:
            plugin: an adapter or its class; or a module or an object with hooks.
            name: unique among the plugins.

        Raises:
            PluginError: the plugin has an unknown hook or argument.
            TypeError: an adapter lacks what every adapter has.
        """
        if isinstance(plugin, type) and issubclass(plugin, HostAdapter):
            plugin = plugin()
        if isinstance(plugin, HostAdapter):
            for attribute, kind in (("name", str), ("info", HostInfo), ("seams", tuple)):
                if not isinstance(getattr(plugin, attribute, None), kind):
                    raise TypeError(f"{type(plugin)!r} has no {attribute} ({kind.__name__})")
        if self._manager.has_plugin(name):
            raise _broken(name, "", "two plugins of this name", "one")
        try:
            self._manager.register(plugin, name)
            self._manager.check_pending()
            hooks = self._manager.get_hookcallers(plugin) or ()
            if not (hooks or isinstance(plugin, HostAdapter)):
                raise ValueError("no hooks")
            for hook in hooks:
                for each in hook.get_hookimpls():
                    if each.plugin is plugin and (each.wrapper or each.hookwrapper):
                        raise ValueError(f"{hook.name} is a wrapper")
        except (pluggy.PluginValidationError, ValueError) as error:
            self._manager.unregister(name=name)
            expected = "an adapter's class, or plain functions for hooks, with their arguments"
            raise _broken(name, "", str(error), expected) from error
        if not isinstance(plugin, HostAdapter):
            return
        if twin := next((each for each in self.adapters if each.name == plugin.name), None):
            where = f"adapter {plugin.name} of plugin {name}"
            found = f"left out: plugin {self._manager.get_name(twin)} has one of this name"
            said = where, found, "one adapter per name", "Set FRAGPRUNE_BLOCK to one of the two."
            self.findings.append(Finding("warning", "adapter-shadowed", *said))
            return
        self.adapters.append(plugin)
        self.adapters.sort(key=lambda each: each.name)

    def remove(self, name: str) -> None:
        """Take back a plugin that was registered under a name."""
        self._manager.unregister(name=name)
        self._off = {each for each in self._off if each[0] != name}

    def ask(
        self, hook: Hook, wrong: Callable[[Any], Wrong | None], one: str = "", **given: Any
    ) -> Any:
        """Ask a hook; returns the first answer that is not None, or None if no plugin answers.

        Args:
            wrong: returns what is wrong with an answer, or None.
            one: what only one plugin should have; a warning names the others.

        Raises:
            PluginError: a plugin raised, or its answer is wrong.
        """
        found: dict[str, Any] = {}
        for each in self._implementations(hook):
            if (one or not found) and (answer := _call(each, hook, given)) is not None:
                if complaint := wrong(answer):
                    raise _broken(each.plugin_name, hook.__name__, *complaint)
                found[each.plugin_name] = answer
        if len(found) > 1:
            said = "%s: of plugins %s the first has it. Set FRAGPRUNE_BLOCK to all but one."
            log.warning(said, one, ", ".join(found))
        return next(iter(found.values()), None)

    def tell(self, hook: Hook, **given: Any) -> None:
        """Call every observer. An observer that raises is reported and not called again."""
        for each in self._implementations(hook):
            if (key := (each.plugin_name, hook.__name__)) not in self._off:
                try:
                    _call(each, hook, given)
                except PluginError as error:
                    self._off.add(key)
                    log.warning("%s Until then it is not called again.", error)

    def answering(self, hook: Hook) -> list[str]:
        """Names of the plugins that are asked, in order."""
        return [each.plugin_name for each in self._implementations(hook)]

    def _implementations(self, hook: Hook) -> Iterator[pluggy.HookImpl]:
        """A hook's implementations in the order of calls: the last one registered comes first."""
        caller: pluggy.HookCaller = getattr(self._manager.hook, hook.__name__)
        return reversed(caller.get_hookimpls())


@cache
def installed() -> Plugins:
    """The plugins of this process, found once; findings are logged."""
    plugins = load_plugins()
    for finding in plugins.findings:
        if finding.level != "info":
            log.warning("%s", finding)
    return plugins


def load_plugins(found: Iterable[EntryPoint] | None = None) -> Plugins:
    """Load all allowed entry points of the group ``fragprune``, or those ``found``, each alone."""
    plugins = Plugins()
    only = _names("FRAGPRUNE_ONLY")
    blocked = _names("FRAGPRUNE_BLOCK")
    for entry in entry_points(group=GROUP) if found is None else found:
        where = f"entry point {entry.name} = {entry.value}"
        if entry.name in blocked or (only and entry.name not in only):
            plugins.findings.append(Finding("info", "plugin-blocked", where, "blocked by name"))
        elif entry.name not in plugins.loaded:
            _load(plugins, entry, where)
        elif entry.value != (first := plugins.loaded[entry.name]):
            remedy = "Uninstall one of the two distributions."
            said = f"the name is taken by {first}", "one plugin per name", remedy
            plugins.findings.append(Finding("warning", "plugin-shadowed", where, *said))
    return plugins


def _load(plugins: Plugins, entry: EntryPoint, where: str) -> None:
    """Load one plugin, or note why not."""
    try:
        plugins.register(entry.load(), entry.name)
    except _FAULTS as error:  # whatever a plugin raises is its own; the others go on
        found = error.found if isinstance(error, PluginError) else _said(error)
        expected = "an adapter's class, or a module that implements known hooks"
        remedy = "Fix it, install it again or uninstall it, or set FRAGPRUNE_BLOCK."
        finding = Finding.error("plugin-failed", where, found, expected, remedy)
        plugins.findings.append(finding)
    else:
        plugins.loaded[entry.name] = entry.value


def _call(implementation: pluggy.HookImpl, hook: Hook, given: dict[str, Any]) -> Any:
    """Call one plugin's hook and return its answer; PluginError if it raised."""
    arguments = [given[name] for name in implementation.argnames]
    try:
        return implementation.function(*arguments)
    except _FAULTS as error:
        frames = traceback.extract_tb(error.__traceback__)[1:2]  # the hook's own; the first is ours
        line = "".join(f" ({Path(each.filename).name}:{each.lineno})" for each in frames)
        plugin, found = implementation.plugin_name, _said(error) + line
        raise _broken(plugin, hook.__name__, found, "an answer") from error


def _said(error: BaseException) -> str:
    return f"{type(error).__name__}: {error}"


def _broken(plugin: str, hook: str, found: str, expected: str) -> PluginError:
    where = f"plugin {plugin}, {hook}" if hook else f"plugin {plugin}"
    remedy = f"Fix or uninstall the plugin, or set FRAGPRUNE_BLOCK={plugin}."
    return PluginError(where, found, expected, remedy)


def _names(variable: str) -> set[str]:
    return {name.strip() for name in os.environ.get(variable, "").split(",") if name.strip()}
