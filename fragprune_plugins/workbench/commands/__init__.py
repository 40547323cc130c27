"""The command line: commands are entry points, ours too, and each is imported on use."""

from __future__ import annotations

import errno
import io
import os
import sys
import traceback
from typing import NoReturn

import click

from fragprune_plugins.errors import PathError, PluginError
from fragprune_plugins.plugins.points import load, offered
from fragprune_plugins.workbench.commands.command import Command, Group

GROUP = "fragprune.commands"  # entry points: a click command each, ours and other packages'


class _Commands(Group):
    """Commands by entry point, imported on use."""

    def list_commands(self, ctx: click.Context) -> list[str]:
        return list(offered(GROUP))

    def get_command(self, ctx: click.Context, cmd_name: str) -> click.Command | None:
        point = offered(GROUP).get(cmd_name)
        if point is None:
            return None
        try:
            command: click.Command = load(point, click.Command)
        except PluginError as error:
            return _broken(cmd_name, error)
        return command


def _broken(name: str, error: PluginError) -> click.Command:
    """Stands for a command whose package fails, so that all the others go on working."""

    def refuse(arguments: tuple[str, ...]) -> NoReturn:
        raise error

    return Command(
        name,
        help=f"Cannot be loaded ({error.found}).",
        context_settings={"ignore_unknown_options": True},
        params=[click.Argument(["arguments"], nargs=-1)],
        callback=refuse,
    )


@click.group(
    cls=_Commands, context_settings={"help_option_names": ["-h", "--help"], "show_default": True}
)
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


def _open_missing_streams() -> None:
    """Open /dev/null for each of stdin, stdout and stderr that is closed, or that takes nothing.

    Else a file that is opened later would get its descriptor, and with it what is printed. A letter
    that a stream cannot encode becomes an escape.
    """
    for number, name, mode in ((0, "stdin", "r"), (1, "stdout", "w"), (2, "stderr", "w")):
        try:
            os.fstat(number) if mode == "r" else os.write(number, b"")  # nice opens it for reading
        except OSError as error:
            if error.errno == errno.EBADF:
                os.dup2(os.open(os.devnull, os.O_RDWR), number)
        if getattr(sys, name) is None:
            setattr(sys, name, open(number, mode, encoding="utf-8", closefd=False))  # noqa: SIM115
    for stream in (sys.stdout, sys.stderr):
        if isinstance(stream, io.TextIOWrapper):
            stream.reconfigure(errors="backslashreplace")


def main() -> None:
    """Entry point of the ``fragprune`` script."""
    _open_missing_streams()
    # By default, OpenMP's threads spin while they wait. On a busy machine, torch on two threads was
    # fifty times slower with spinning threads than with sleeping ones.
    os.environ.setdefault("OMP_WAIT_POLICY", "PASSIVE")
    try:
        cli(prog_name="fragprune")
    except OSError as error:
        printing = traceback.extract_tb(error.__traceback__)[-1].name == click.echo.__name__
        if error.errno not in (errno.ENOSPC, errno.EDQUOT) or not printing:  # of another file
            raise
        os.dup2(os.open(os.devnull, os.O_WRONLY), 1)  # what is left goes there at the end
        full = PathError("stdout", "no space left there", "a stream that takes it", "Free space.")
        click.echo(str(full), err=True)
        sys.exit(1)
