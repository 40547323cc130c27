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
@click.option(
    "--prove",
    is_flag=True,
    help="Check every engine that runs here, and the GPU's kernels as the CPU emulates them, "
    "against the oracle; then time the engines that agree, in turns with other rasterizers that "
    "are installed. On a CPU it takes under a minute.",
)
def command(build_cuda: str | None, prove: bool) -> Report:
    """Report versions, engines, the native build and plugins, for a bug report.

    If there is a GPU, the cuda engine is checked on it: its pictures and gradients are compared
    with those of the other engines. The exit code is 1 if something is wrong; the output names the
    remedy.

    \b
    Examples:
      fragprune doctor --json
      fragprune doctor --build-cuda 80,86,90
      fragprune doctor --prove --json > proof.json
    """
    from fragprune_plugins.workbench.doctor import prove as proving
    from fragprune_plugins.workbench.doctor import work

    if prove:
        return proving.prove()
    return work.examine() if build_cuda is None else work.build(build_cuda)
