"""Runs the demo: training, fine-tuning, its control, and the page that says what came of it."""

from __future__ import annotations

import contextlib
import sys
import time
from dataclasses import replace
from functools import partial
from pathlib import Path

import click

from fragprune_plugins.errors import OutputError
from fragprune_plugins.learning.goals import Control
from fragprune_plugins.learning.schedule import Settings
from fragprune_plugins.workbench.commands.command import Report
from fragprune_plugins.workbench.commands.opening import open_engine
from fragprune_plugins.workbench.commands.options import EngineOptions
from fragprune_plugins.workbench.demo.scene import make_scene
from fragprune_plugins.workbench.figures import wording
from fragprune_plugins.workbench.models.model import writable_folder
from fragprune_plugins.workbench.report.page import save, save_banner
from fragprune_plugins.workbench.report.work import results
from fragprune_plugins.workbench.run.work import run

HOST = Path(__file__).with_name("host") / "train.py"  # the training script of the demo's host
PAGE, PICTURES = "index.html", "pictures"
BANNER = "banner.jpg"  # the picture that shows all of it at a glance
LARGER = 2  # how many times as wide and high the page's pictures are as the photographs
_FIRST = "view_032.webp"  # the table stands under the divider: both halves show the same things
_TITLE = "The same picture from fewer fragments"
_TEMPLATE = Path(__file__).with_name("demo.html")


def demo(*, out: Path, iters: int, seed: int, engine: EngineOptions) -> Report:
    """Do what ``fragprune demo`` promises; its options are the arguments."""
    started, say = time.perf_counter(), partial(click.echo, err=True)
    _, where = open_engine(engine)
    engine = replace(engine, device=str(where))
    _expect_empty(out)
    make_scene(out / "scene")
    words = host_command((out / "scene").resolve(), (out / "model").resolve(), iters, seed)
    settings = Settings(iterations=iters // 2, seed=seed)
    train = partial(run, host_command=tuple(words), engine=engine)
    with contextlib.redirect_stdout(sys.stderr):
        then = f"then for {settings.iterations} without cutoffs, the control"
        say(f"1/3  Training for {iters} iterations, {then}")
        train(stage="auto", settings=replace(settings, goal=Control()))
        say(f"2/3  The same {settings.iterations} iterations with a cutoff for every Gaussian")
        report = train(stage="finetune", settings=settings)
    say("3/3  Drawing the pictures")
    files = write_page(out, engine)
    data = report.data | {"files": files, "seconds": time.perf_counter() - started}
    line = f"Took {data['seconds']:.0f} s. Open {out / PAGE} for the pictures."
    return Report(data, f"\n{report.text}\n{line}", report.exit_code)


def _expect_empty(out: Path) -> None:
    """Make the folder; OutputError if it holds a file, but for hidden ones of file managers."""
    held = [each.name for each in writable_folder(out).iterdir() if each.name[0] != "."]
    if held:
        found, remedy = f"holds {min(held)!r}", "Choose another --out, or delete the folder."
        raise OutputError(str(out), found, "a new or empty folder", remedy)


def host_command(scene: Path, model: Path, iters: int, seed: int) -> list[str]:
    """The command that trains the host on the scene; densification keeps pace with iterations."""
    flags: dict[str, object] = {
        "-s": scene,
        "-m": model,
        "--iterations": iters,
        "--sh_degree": 1,
        "--position_lr_max_steps": iters,
        "--densify_from_iter": iters // 10,
        "--densify_until_iter": int(iters * 0.65),
        "--densification_interval": max(1, iters // 20),
        "--opacity_reset_interval": 10 * iters,  # never: the training is too short to recover
        "--densify_grad_threshold": 0.0005,
        "--test_iterations": -1,
        "--save_iterations": iters,
        "--seed": seed,
    }
    words = [str(word) for flag in flags.items() for word in flag]
    return [str(HOST), *words, "--eval"]


def write_page(out: Path, engine: EngineOptions) -> list[str]:
    """Write the report of ``out``, with pictures beside it; returns the files, relative to it."""
    pictures = writable_folder(out / PICTURES)
    given = out, pictures, out / "scene", engine
    values, _ = results(*given, enlarge=LARGER, first=_FIRST)
    if values["views"]:
        save_banner(pictures / BANNER, pictures, values["views"][0])
    values |= {"title": _TITLE, "shown_by": f"fragprune view {wording.quoted(out)}"}
    save(out / PAGE, _TEMPLATE, (PICTURES + "/").__add__, values)
    return [*(f"{PICTURES}/{each.name}" for each in sorted(pictures.iterdir())), PAGE]
