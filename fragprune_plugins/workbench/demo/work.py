"""Runs the demo: training, fine-tuning, measurement, pictures; says what came of it."""

from __future__ import annotations

import contextlib
import json
import sys
import time
from collections.abc import Callable
from dataclasses import dataclass, field, replace
from functools import partial
from pathlib import Path
from typing import Any

import click

from fragprune_plugins.files.atomic import replacing
from fragprune_plugins.hosts.photographs import Photographs
from fragprune_plugins.injection.launch import RunOptions, run
from fragprune_plugins.learning import goals, schedule
from fragprune_plugins.plugins.hooks import engine_for
from fragprune_plugins.workbench.commands.command import Report
from fragprune_plugins.workbench.commands.opening import open_engine
from fragprune_plugins.workbench.commands.options import EngineOptions
from fragprune_plugins.workbench.demo.folder import claiming, clear
from fragprune_plugins.workbench.demo.scene import POINTS, VIEWS, WIDTH, make_scene
from fragprune_plugins.workbench.figures import evaluate, records, wording
from fragprune_plugins.workbench.models import model as models
from fragprune_plugins.workbench.report import page as report_page
from fragprune_plugins.workbench.run.work import Looking, figures_of
from fragprune_plugins.workbench.scenes.dataset import load_dataset

HOST = Path(__file__).with_name("host") / "train.py"  # the training script of the demo's host
REPORT = "report.json"  # the report's file in the demo's folder; the demo writes it last
LARGER = 2  # how many times as wide and high the page's pictures are as the photographs
BANNER = "banner.jpg"  # the picture that shows all of it at a glance
_FIRST = "view_032.webp"  # the table stands under the divider: both halves show the same things
_TEMPLATE = Path(__file__).with_name("demo.html")
_REPEATS = 5  # timed frames for each view


@dataclass(frozen=True)
class DemoSettings:
    """Settings of a demo: its training, and its scene as ``make_scene`` takes it."""

    iterations: int = 1000
    finetune: int = 500  # iterations of stage 2
    seed: int = 0
    engine: EngineOptions = field(default_factory=partial(EngineOptions, device="cpu"))
    views: int = VIEWS
    width: int = WIDTH
    points: int = POINTS


def demo(*, out: Path, iters: int, seed: int, engine: EngineOptions) -> Report:
    """Do what ``fragprune demo`` promises; its options are the arguments."""
    _, where = open_engine(engine)
    drawing = replace(engine, device=str(where))
    settings = DemoSettings(iterations=iters, finetune=iters // 2, seed=seed, engine=drawing)
    report = run_demo(out, settings, partial(click.echo, err=True))
    lines = [
        "",
        wording.describe(wording.columns_of(report)),
        "",
        wording.outcome("run", report, report["control"]),
        *wording.begun(report),
        f"Took {report['seconds']:.0f} s. Open {out / 'index.html'} for the pictures. "
        f"To turn it: fragprune view {wording.quoted(out)}",
    ]
    return Report(report, "\n".join(lines))


def host_command(scene: Path, model: Path, settings: DemoSettings) -> list[str]:
    """The command that trains the host on the scene; densification keeps pace with iterations."""
    n = settings.iterations
    flags: dict[str, object] = {
        "-s": scene,
        "-m": model,
        "--iterations": n,
        "--sh_degree": 1,
        "--position_lr_max_steps": n,
        "--densify_from_iter": n // 10,
        "--densify_until_iter": int(n * 0.65),
        "--densification_interval": max(1, n // 20),
        "--opacity_reset_interval": 10 * n,  # never: the training is too short to recover
        "--densify_grad_threshold": 0.0005,
        "--test_iterations": -1,
        "--save_iterations": n,
        "--seed": settings.seed,
    }
    words = [str(word) for flag in flags.items() for word in flag]
    return [str(HOST), *words, "--eval"]


def run_demo(
    out: Path, settings: DemoSettings, say: Callable[[str], None] = lambda line: None
) -> dict[str, Any]:
    """Train the host on the room, fine-tune, measure and draw; says how far it is."""
    clear(out)
    started = time.perf_counter()
    scene, model = out / "scene", out / "model"
    with claiming(out, "scene"):
        make_scene(scene, views=settings.views, width=settings.width, points=settings.points)
    command = host_command(scene.resolve(), model.resolve(), settings)
    learning = schedule.Settings(iterations=settings.finetune, seed=settings.seed)
    at = settings.engine
    looking = Looking(at)
    options = RunOptions(settings=learning, engine=at.name, device=at.device, look=looking)
    with claiming(out, "model"), contextlib.redirect_stdout(sys.stderr):
        then = f"then with a cutoff for every Gaussian for {settings.finetune}"
        say(f"1/4  Training for {settings.iterations} iterations, {then}")
        summary = run(command, options)
        say(f"2/4  The control: the same {settings.finetune} iterations without cutoffs")
        without = replace(learning, goal=goals.Control())
        zero = run(command, replace(options, stage="finetune", settings=without, look=None))
    saved = summary.model_before, summary.model_after, zero.model_after
    paths = [path for path in saved if path is not None]  # all: the host saves at its last step
    say("3/4  Measuring on the held-out views")
    before, after, control = evaluate.measure_all(
        [evaluate.Candidate(models.load(path, device=at.device)) for path in paths],
        load_dataset(scene).test,
        engine=at.name,
        repeats=_REPEATS,
    )
    report = figures_of(summary, learning, looking, before, after)
    report |= {"control": control, "engine": after["engine"], "device": after["device"]}
    say("4/4  Drawing the pictures")
    with claiming(out, "pictures", "index.html", "model"):
        report["files"] = write_page(out, report, scene, summary.curves, at)
        pair = tuple(paths[:2])
        read = records.Recorded(Photographs(scene), pair, filtered=True, drawing=summary.drawing)
        more = {"curves": summary.curves, "photographs": read.as_dict()}
        records.leave(pair[1], "run", report | more)  # as of run, for report
    report["seconds"] = time.perf_counter() - started
    with claiming(out, REPORT), replacing(out / REPORT) as path:
        path.write_text(json.dumps(report, indent=2) + "\n", encoding="utf-8")
    return report


def write_page(
    out: Path,
    report: dict[str, Any],
    scene: Path,
    curves: list[dict[str, float]],
    engine: EngineOptions,
) -> list[str]:
    """Write ``pictures/`` and ``index.html``; returns their files, relative to ``out``."""
    pictures = out / "pictures"
    saved = (report[f"model_{key}"] for key in ("before", "after"))
    one, other = (models.load(path, device=engine.device) for path in saved)
    original, pruned = evaluate.Candidate(one.untruncated()), evaluate.Candidate(other)
    shots = sorted(load_dataset(scene).test, key=lambda shot: shot.name != _FIRST)
    rasterizer = engine_for(engine.name, engine.device)
    drawn = report_page.draw_views(pictures, original, pruned, shots, rasterizer, LARGER)
    report_page.save_banner(pictures / BANNER, pictures, drawn)
    files = [*drawn.files, BANNER]
    plots = []
    if curves and other.falloff is not None:
        report_page.save_learning(pictures / report_page.LEARNING, curves, other.falloff)
        files.append(report_page.LEARNING)
        plots = [("How it learned", report_page.LEARNING)]
    text = report_page.compose(
        _TEMPLATE,
        drawn,
        lambda file: f"pictures/{file}",
        title="The same picture from fewer fragments",
        facts=wording.headlines(report, report["control"]),
        quote=wording.outcome("run", report, report["control"]),
        seen=False,
        notes=wording.begun(report),
        table=report_page.figures(
            {"original": report["before"], "control": report["control"], "pruned": report["after"]}
        ),
        plots=plots,
        others=[],
        folder=str(out),
    )
    with replacing(out / "index.html") as path:
        path.write_text(text, encoding="utf-8")
    return [*(f"pictures/{file}" for file in files), "index.html"]
