"""``fragprune adapters``: lists the installed adapters, and what is known of them."""

from __future__ import annotations

from pathlib import Path

import click

from fragprune_plugins.hosts.adapter import HostAdapter, ScriptAdapter
from fragprune_plugins.hosts.source import HostRepo
from fragprune_plugins.plugins.loading import load_plugins
from fragprune_plugins.workbench.commands.command import Command, Report


@click.command("adapters", cls=Command)
def command() -> Report:
    """List the installed adapters, and every plugin that was blocked or failed.

    \b
    Example:
      fragprune adapters --json
    """
    plugins = load_plugins()
    adapters = [
        {
            "name": adapter.name,
            "title": adapter.info.title,
            "repo": adapter.info.repo,
            "states": adapter.info.states,
            "scripts": list(scripts(adapter)),
            "limits": list(adapter.info.limits),
            "seams": [
                {"role": seam.role.name, "where": str(seam), "needs": list(seam.needs)}
                for seam in adapter.seams
            ],
        }
        for adapter in plugins.adapters
    ]
    width = max((len(adapter.name) for adapter in plugins.adapters), default=0)
    lines = [
        f"{{name:<{width}}}  {{title}}, github {{repo}}: {{states}}".format(**adapter)
        for adapter in adapters
    ] or ["No adapter is installed."]
    lines += [str(finding) for finding in plugins.findings]
    data = {"adapters": adapters, "findings": [f.as_dict() for f in plugins.findings]}
    failed = any(finding.level == "error" for finding in plugins.findings)
    return Report(data, "\n".join(lines), exit_code=1 if failed else 0)


def scripts(adapter: HostAdapter) -> tuple[str, ...]:
    """Training scripts, of any revision: paths in the checkout or modules of the package."""
    if not isinstance(adapter, ScriptAdapter):
        return (adapter.info.usage,) if adapter.info.usage else ()
    return adapter.command_line(HostRepo(Path("/nonexistent"))).scripts
