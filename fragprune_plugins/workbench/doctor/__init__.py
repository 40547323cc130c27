"""``fragprune doctor``: reports the versions, engines and plugins of this installation."""

from __future__ import annotations

import click

from fragprune_plugins.workbench.commands.command import Command, Report


@click.command("doctor", cls=Command)
@click.option(
    "--build-cuda",
    metavar="ARCHITECTURES",
    help="Compile the GPU kernels in advance for these compute capabilities, such as 80,90; needs "
    "no GPU.",
)
def command(build_cuda: str | None) -> Report:
    """Report versions, engines, the native build and plugins, for a bug report.

    If there is a GPU, the cuda engine is checked on it: its pictures and gradients are compared
    with those of the other engines. The exit code is 1 if something is wrong; the output names the
    remedy.

    \b
    Examples:
      fragprune doctor --json
      fragprune doctor --build-cuda 80,86,90
    """
    from fragprune_plugins.workbench.doctor.work import build, examine

    return examine() if build_cuda is None else build(build_cuda)
