"""``fragprune demo``: shows fragprune at work without a GPU, a download or a repository."""

from __future__ import annotations

from typing import Any

import click

from fragprune_plugins.workbench.commands.command import Command, Report, work_of
from fragprune_plugins.workbench.commands.options import FILE, engine_options


@click.command("demo", cls=Command)
@click.option(
    "--out",
    type=FILE,
    default="fragprune-demo",
    help="Folder for the scene, the models, the pictures and index.html: a new or empty one.",
)
@click.option(
    "--iters",
    type=click.IntRange(min=100),
    default=1000,
    help="Iterations of the training; the fine-tuning runs half as many.",
)
@click.option("--seed", type=int, default=0, help="Seed of the training.")
@engine_options(device="Device; the scene is small enough for any CPU.", default="cpu")
def command(**options: Any) -> Report:
    """Train a model of a small room, prune its fragments, and show original and pruned.

    It takes a few minutes on a laptop and downloads nothing: 48 photographs come with fragprune.

    \b
    Example:
      fragprune demo --out fragprune-demo
    """
    return work_of(__name__, **options)
