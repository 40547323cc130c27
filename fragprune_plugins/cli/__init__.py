"""The command line: one module for each command, imported on use. None imports torch early."""

from __future__ import annotations

import io
import os
import sys
from importlib import import_module
from importlib.util import find_spec

import click

from fragprune_plugins.cli.common import Group

_COMMANDS = {
    "demo": "demo",
    "run": "run",
    "finetune": "finetune",
    "render": "render",
    "view": "view",
    "profile": "profile",
    "audit": "audit",
    "compare": "compare",
    "export": "export",
    "report": "report",
    "adapters": "adapters",
    "bridge": "bridge",
    "check": "check",
    "bench": "bench",
    "experiment": "experiment",
    "doctor": "doctor",
    "completion": "completion",
}
"""Modules of this package by command name, in the order of --help; each defines ``command``."""


class _LazyGroup(Group):
    def list_commands(self, ctx: click.Context) -> list[str]:
        return [name for name in _COMMANDS if _present(name)]

    def get_command(self, ctx: click.Context, cmd_name: str) -> click.Command | None:
        if cmd_name not in _COMMANDS or not _present(cmd_name):
            return None
        command: click.Command = import_module(f"{__name__}.{_COMMANDS[cmd_name]}").command
        return command


def _present(name: str) -> bool:
    return find_spec(f"{__name__}.{_COMMANDS[name]}") is not None


@click.group(cls=_LazyGroup, context_settings={"help_option_names": ["-h", "--help"]})
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
