"""``fragprune check``: tells from its source which adapter fits a host."""

from __future__ import annotations

from typing import Any

import click

from fragprune_plugins.workbench.commands.command import Command, Report, work_of
from fragprune_plugins.workbench.commands.options import FILE


@click.command("check", cls=Command)
@click.argument("hosts", metavar="HOST...", type=FILE, nargs=-1, required=True)
@click.option(
    "--adapter", help="Check only this adapter, and show where every seam is and what is wrong."
)
def command(**options: Any) -> Report:
    """Read HOST, a training repository, and say what fragprune can do with it.

    The first sentence is one of three: an adapter fits; none does, but the PLY that it saves is
    plain 3DGS, with the command that prunes it; or it is not possible, and why. Then come the
    differences from the nearest host.

    Nothing is imported or run, and no GPU is needed. The output lists packages that the host
    imports and that are not installed. --adapter shows for every seam the file and line where it
    was found, changed or expected, and lists what does not work. Several HOSTs give a table. The
    exit code is 0 if exactly one adapter fits.

    \b
    Examples:
      fragprune check ~/code/gaussian-splatting
      fragprune check ~/code/my-fork --adapter vanilla-3dgs     (why does it not fit?)
      fragprune check gsplat                                    (an installed package)
      fragprune check ~/forks/*                                 (a table)
    """
    return work_of(__name__, **options)
