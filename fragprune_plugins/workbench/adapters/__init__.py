"""``fragprune adapters``: lists the installed adapters."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from string import Template
from typing import TYPE_CHECKING

import click

from fragprune_plugins.workbench.commands.common import Command, Report

if TYPE_CHECKING:
    from fragprune_plugins.hosts.adapter import HostAdapter


@click.command("adapters", cls=Command)
@click.option("--table", is_flag=True, help="Print the support table, in Markdown.")
def command(table: bool) -> Report:
    """List the installed adapters, and every plugin that was blocked or failed.

    \b
    Examples:
      fragprune adapters --json
      fragprune adapters --table > docs/reference/support.md
    """
    from fragprune_plugins.plugins.loading import load_plugins

    plugins = load_plugins()
    adapters = [
        {
            "name": adapter.name,
            "title": adapter.info.title,
            "repo": adapter.info.repo,
            "states": adapter.info.states,
            "scripts": list(_scripts(adapter)),
            "limits": list(adapter.info.limits),
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
    text = support(plugins.adapters) if table else "\n".join(lines)
    return Report(data, text, exit_code=1 if failed else 0)


def support(adapters: Sequence[HostAdapter]) -> str:
    """The support page in Markdown, made from the adapters alone."""
    from fragprune_plugins.engines import ENGINES

    head = ["host", "adapter", "states", "scripts that train"]
    rows = [head, ["---"] * len(head)]
    limits = []
    for adapter in adapters:
        info = adapter.info
        host = f"[{info.title}](https://github.com/{info.repo})"
        scripts = ", ".join(f"`{script}`" for script in _scripts(adapter)) or "your own"
        rows.append([host, f"`{adapter.name}`", info.states, scripts])
        limits += [f"* `{adapter.name}`: {limit}" for limit in info.limits]
    table = "\n".join("| " + " | ".join(cells) + " |" for cells in rows)
    return _SUPPORT.substitute(
        table=table,
        engines=", ".join(f"`{name}`" for name in ENGINES),
        installed=" and ".join(f"`{a.name}`" for a in adapters if a.installed and not a.info.usage),
        methods=" and ".join(f"`{a.name}`" for a in adapters if a.info.usage),
        limits="\n".join(limits),
    )


def _scripts(adapter: HostAdapter) -> tuple[str, ...]:
    """Training scripts: paths in the checkout or modules of the package; () for a library.

    They are the same for all revisions.
    """
    from fragprune_plugins.hosts.adapter import ScriptAdapter
    from fragprune_plugins.hosts.source import HostRepo

    if not isinstance(adapter, ScriptAdapter):
        return (adapter.info.usage,) if adapter.info.usage else ()
    return adapter.command_line(HostRepo(Path("/nonexistent"))).scripts


_SUPPORT = Template("""# What is supported

<!-- Made by `fragprune adapters --table`; a test compares it with the adapters. -->

Scripts that do not train (render, evaluate) also run under `fragprune run`, with the thresholds
beside their models. Every adapter draws with every engine: $engines. `fragprune check DIR` says
which adapter fits a checkout, and why others do not. Our adapters pass the
[conformance kit](conformance.md): $installed on the installed packages, the others on miniatures of
their hosts. $methods is a method of its host, with
[tests of its own](../how-to/nerfstudio.md#test-it).

$table

## What does not work or is refused

$limits""")
