"""``fragprune adapters``: which hosts this installation knows."""

from __future__ import annotations

import click

from fragprune_plugins.cli.common import Command, Report


@click.command("adapters", cls=Command)
def command() -> Report:
    """List the installed adapters and every plugin that was blocked or failed.

    \b
    Example:
      fragprune adapters --json
    """
    from fragprune_plugins.plugins import load_plugins

    plugins = load_plugins()
    adapters = [
        {
            "name": adapter.name,
            "title": adapter.info.title,
            "repo": adapter.info.repo,
            "states": adapter.info.states,
            "seams": [
                {"role": seam.role.name, "where": str(seam), "needs": list(seam.needs)}
                for seam in adapter.seams
            ],
        }
        for adapter in plugins.adapters
    ]
    lines = [
        f"{adapter.name:<16} {adapter.info.title}, github {adapter.info.repo}: "
        f"{adapter.info.states}"
        for adapter in plugins.adapters
    ] or ["No adapter is installed."]
    lines += [str(finding) for finding in plugins.findings]
    data = {"adapters": adapters, "findings": [f.as_dict() for f in plugins.findings]}
    failed = any(finding.level == "error" for finding in plugins.findings)
    return Report(data, "\n".join(lines), exit_code=1 if failed else 0)
