"""Runs the demo, and says what came of it."""

from __future__ import annotations

from pathlib import Path

import click

from fragprune_plugins.workbench.commands.command import Report
from fragprune_plugins.workbench.commands.opening import open_engine
from fragprune_plugins.workbench.commands.options import EngineOptions
from fragprune_plugins.workbench.demo.demo import DemoSettings, run_demo
from fragprune_plugins.workbench.figures.wording import describe, frames, outcome


def demo(*, out: Path, iters: int, seed: int, engine: EngineOptions) -> Report:
    """Do what ``fragprune demo`` promises; its options are the arguments."""
    _, where = open_engine(engine)
    settings = DemoSettings(
        iterations=iters, finetune=iters // 2, seed=seed, engine=engine.name, device=str(where)
    )
    report = run_demo(out, settings, lambda line: click.echo(line, err=True))
    larger = report["larger"]
    table = describe({"original": report["before"], "pruned": report["after"]})
    text = (
        f"\n{table}\n\n{outcome('run', report, report['control'])}\n"
        f"Of larger pictures, {larger['size']}: {frames(larger['before'], larger['after'])}.\n"
        f"Took {report['seconds']:.0f} s. Open {out / 'index.html'} for the pictures. "
        f"To turn it: fragprune view {out}"
    )
    return Report(report, text)
