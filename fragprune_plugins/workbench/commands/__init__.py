"""The command line: commands are entry points, ours too, and each is imported on use."""

from __future__ import annotations

import io
import os
import sys
from importlib.metadata import EntryPoint, entry_points

import click

from fragprune_plugins.errors import PluginError
from fragprune_plugins.workbench.commands.common import Group

GROUP = "fragprune.commands"
"""The entry-point group of commands: a click command each, ours and those of other packages."""


class _Commands(Group):
    """Commands by entry point, imported on use."""

    def list_commands(self, ctx: click.Context) -> list[str]:
        return sorted({point.name for point in entry_points(group=GROUP)})

    def get_command(self, ctx: click.Context, cmd_name: str) -> click.Command | None:
        points = entry_points(group=GROUP, name=cmd_name)
        return self._load(next(iter(points))) if points else None

    def _load(self, point: EntryPoint) -> click.Command:
        """The command of an entry point, or one that says why it cannot be had."""
        try:
            command = point.load()
            if not isinstance(command, click.Command):
                raise TypeError(f"{point.value} is a {type(command).__name__}, no click command")
        except Exception as error:
            return _Broken(point, error)
        return command


class _Broken(click.Command):
    """Stands for a command whose package fails, so that all the others go on working."""

    def __init__(self, point: EntryPoint, error: Exception) -> None:
        owner = point.dist.name if point.dist else point.value
        self.why = f"{type(error).__name__}: {error}".splitlines()[0]
        super().__init__(
            point.name,
            help=f"Cannot be loaded ({owner}: {self.why}).",
            context_settings={"ignore_unknown_options": True},
            params=[click.Argument(["arguments"], nargs=-1)],
            callback=lambda arguments: self._refuse(owner),
        )

    def _refuse(self, owner: str) -> None:
        raise PluginError(
            f"fragprune {self.name}",
            self.why,
            f"a command of the package {owner}",
            f"Update or uninstall {owner}.",
        )


@click.group(cls=_Commands, context_settings={"help_option_names": ["-h", "--help"]})
@click.version_option(package_name="fragprune-plugins", prog_name="fragprune")
def cli() -> None:
    """Learned fragment pruning for Gaussian splatting: the same picture from fewer fragments.

    Every Gaussian learns how far it reaches; fragments beyond that are neither sorted nor blended.

    \b
    I have a training repository   fragprune run -- python train.py -s scene -m out
    I have a trained .ply          fragprune finetune point_cloud.ply --data scene --out pruned.ply
    What did I gain?               fragprune compare point_cloud.ply pruned.ply --data scene
    What does it cost to draw?     fragprune audit point_cloud.ply --out audit
    Show me, no GPU needed         fragprune demo

    Every command takes --json (one object on stdout, progress on stderr) and --help.
    """


def _stand() -> None:
    """Give the process the streams that it may have been started without.

    A file that is opened in the place of a closed stream would get what is written to that. A
    letter that a stream cannot write becomes an escape.
    """
    for number, name, mode in ((0, "stdin", "r"), (1, "stdout", "w"), (2, "stderr", "w")):
        try:
            os.fstat(number)
        except OSError:
            os.open(os.devnull, os.O_RDWR)  # takes the lowest number that is free
        if getattr(sys, name) is None:
            setattr(sys, name, open(number, mode, encoding="utf-8", closefd=False))  # noqa: SIM115
    for stream in (sys.stdout, sys.stderr):
        if isinstance(stream, io.TextIOWrapper):
            stream.reconfigure(errors="backslashreplace")


def main() -> None:
    """Entry point of the ``fragprune`` script."""
    _stand()
    # By default, OpenMP's threads spin while they wait. On a busy machine, torch on two threads was
    # fifty times slower with spinning threads than with sleeping ones.
    os.environ.setdefault("OMP_WAIT_POLICY", "PASSIVE")
    cli(prog_name="fragprune")
