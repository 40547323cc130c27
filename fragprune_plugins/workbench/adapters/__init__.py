"""``fragprune adapters``: lists the installed adapters."""

from __future__ import annotations

import click

from fragprune_plugins.workbench.commands.command import Command, Report, work_of


@click.command("adapters", cls=Command)
def command() -> Report:
    """List the installed adapters, and every plugin that was blocked or failed.

    \b
    Example:
      fragprune adapters --json
    """
    return work_of(__name__)
