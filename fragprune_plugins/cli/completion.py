"""``fragprune completion``: prints what a shell needs to complete commands and options."""

from __future__ import annotations

import click
from click.shell_completion import get_completion_class

from fragprune_plugins.cli.common import Command, Report


@click.command("completion", cls=Command)
@click.argument("shell", type=click.Choice(["bash", "zsh", "fish"]))
@click.pass_context
def command(ctx: click.Context, shell: str) -> Report:
    """Print the completion script of a SHELL.

    \b
    Examples:
      eval "$(fragprune completion bash)"                      (in ~/.bashrc)
      eval "$(fragprune completion zsh)"                       (in ~/.zshrc)
      fragprune completion fish > ~/.config/fish/completions/fragprune.fish
    """
    kind = get_completion_class(shell)
    assert kind is not None, "click knows the shells of the choice"
    program = ctx.find_root().command
    script = kind(program, {}, "fragprune", "_FRAGPRUNE_COMPLETE").source()
    return Report({"shell": shell, "script": script}, script.rstrip("\n"))
