"""``fragprune demo``: shows fragprune at work without a GPU, a download or a repository."""

from __future__ import annotations

import os
from pathlib import Path

import click

from fragprune_plugins.workbench.commands.command import Command, Report
from fragprune_plugins.workbench.commands.options import FILE, EngineOptions, engine_options


@click.command("demo", cls=Command)
@click.option(
    "--out",
    type=FILE,
    default="fragprune-demo",
    show_default=True,
    help="Folder for the scene, the models, the pictures and index.html: a new folder, or the "
    "folder of an earlier demo, which is emptied.",
)
@click.option(
    "--iters",
    type=click.IntRange(min=100),
    default=1000,
    show_default=True,
    help="Iterations of the training; the fine-tuning runs half as many.",
)
@click.option("--seed", type=int, default=0, show_default=True, help="Seed of the training.")
@engine_options(device="Device; the scene is small enough for any CPU.", default="cpu")
def command(out: Path, iters: int, seed: int, engine: EngineOptions) -> Report:
    """Train a model of a small room, prune its fragments, and show original and pruned.

    It takes a few minutes on a laptop and downloads nothing: 48 photographs come with fragprune.

    \b
    Example:
      fragprune demo --out fragprune-demo
    """
    # torch reads this when it loads. Idle threads sleep, and leave the CPU to other programs.
    os.environ.setdefault("OMP_WAIT_POLICY", "PASSIVE")
    from fragprune_plugins.workbench.commands.opening import open_engine
    from fragprune_plugins.workbench.demo.demo import DemoSettings, run_demo
    from fragprune_plugins.workbench.figures.wording import describe, frames, outcome

    _, where = open_engine(engine)
    settings = DemoSettings(
        iterations=iters, finetune=iters // 2, seed=seed, engine=engine.name, device=str(where)
    )
    report = run_demo(out, settings, lambda line: click.echo(line, err=True))
    larger = report["larger"]
    table = describe({"before": report["before"], "after": report["after"]})
    text = (
        f"\n{table}\n\n{outcome('run', report, report['control'])}\n"
        f"Of larger pictures, {larger['size']}: {frames(larger['before'], larger['after'])}.\n"
        f"Took {report['seconds']:.0f} s. Open {out / 'index.html'} for the pictures."
    )
    return Report(report, text)
