"""Runs the demo: training, fine-tuning, measurement, pictures; says what came of it."""

from __future__ import annotations

import contextlib
import json
import sys
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any

import click

from fragprune_plugins.files.atomic import replacing
from fragprune_plugins.hosts.photographs import Photographs
from fragprune_plugins.injection.launch import RunOptions, RunSummary, run
from fragprune_plugins.learning.goals import Control
from fragprune_plugins.learning.schedule import Settings
from fragprune_plugins.plugins.hooks import engine_for
from fragprune_plugins.workbench.commands.command import Report
from fragprune_plugins.workbench.commands.opening import open_engine
from fragprune_plugins.workbench.commands.options import EngineOptions
from fragprune_plugins.workbench.demo.folder import claiming, clear
from fragprune_plugins.workbench.demo.scene import POINTS, VIEWS, WIDTH, make_scene
from fragprune_plugins.workbench.figures import records
from fragprune_plugins.workbench.figures.evaluate import (
    Candidate,
    enlarged,
    frame_times,
    measure_all,
)
from fragprune_plugins.workbench.figures.recorded import Recorded
from fragprune_plugins.workbench.figures.wording import begun, describe, frames, headlines, outcome
from fragprune_plugins.workbench.finetune.trial import Trial
from fragprune_plugins.workbench.models import model as models
from fragprune_plugins.workbench.report import page as report_page
from fragprune_plugins.workbench.run.work import Looking
from fragprune_plugins.workbench.scenes.dataset import load_dataset

HOST = Path(__file__).with_name("host") / "train.py"
"""The training script of the demo's host."""

REPORT = "report.json"
"""The report's file in the demo's folder; the demo writes it last."""

LARGER = 2
"""How many times as wide and high the page's pictures are as the photographs of the training."""

BANNER = "banner.jpg"
"""The picture that shows all of it at a glance."""

_FIRST = "view_032.webp"  # the table stands under the divider: both halves show the same things

_TEMPLATE = Path(__file__).with_name("demo.html")

_REPEATS = 5  # timed frames for each view


@dataclass(frozen=True)
class DemoSettings:
    """Settings of a demo.

    Attributes:
        iterations, finetune: of the host's own training, and of stage 2.
        views, width, points: of the scene, as ``make_scene`` takes them.
    """

    iterations: int = 1000
    finetune: int = 500
    seed: int = 0
    engine: str = "auto"
    device: str = "cpu"
    views: int = VIEWS
    width: int = WIDTH
    points: int = POINTS


def demo(*, out: Path, iters: int, seed: int, engine: EngineOptions) -> Report:
    """Do what ``fragprune demo`` promises; its options are the arguments."""
    _, where = open_engine(engine)
    settings = DemoSettings(
        iterations=iters, finetune=iters // 2, seed=seed, engine=engine.name, device=str(where)
    )
    report = run_demo(out, settings, partial(click.echo, err=True))
    larger = report["larger"]
    table = describe({"original": report["before"], "pruned": report["after"]})
    told = [outcome("run", report, report["control"]), *begun(report)]
    text = (
        f"\n{table}\n\n" + "\n".join(told) + "\n"
        f"Of larger pictures, {larger['size']}: {frames(larger['before'], larger['after'])}.\n"
        f"Took {report['seconds']:.0f} s. Open {out / 'index.html'} for the pictures. "
        f"To turn it: fragprune view {out}"
    )
    return Report(report, text)


def host_command(scene: Path, model: Path, settings: DemoSettings) -> list[str]:
    """The command that trains the host on the scene.

    Its flags scale the timetable of densification to the number of iterations.
    """
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
    """Train the host on the room, fine-tune, measure and draw. Progress goes to stderr.

    Args:
        out: folder for ``scene/``, ``model/``, ``pictures/``, ``index.html`` and ``report.json``.
        say: called with one line of text at the start of each part.

    Returns:
        The report. "before", "after" and "control" are measurements on held-out views; the control
        learned for as many iterations without cutoffs. "seconds_by_part" are wall times.

    Raises:
        OutputError: the folder cannot be written, or holds files that no demo wrote.
    """
    clear(out)
    seconds: dict[str, float] = {}
    scene, model = out / "scene", out / "model"
    with claiming(out, "scene"):
        make_scene(scene, views=settings.views, width=settings.width, points=settings.points)
    with (
        _timed(seconds, "train"),
        claiming(out, "model"),
        contextlib.redirect_stdout(sys.stderr),
    ):
        command = host_command(scene.resolve(), model.resolve(), settings)
        say(
            f"1/4  Training for {settings.iterations} iterations, then with a cutoff for "
            f"every Gaussian for {settings.finetune}"
        )
        learning = Settings(iterations=settings.finetune, seed=settings.seed)
        at = EngineOptions(settings.engine, settings.device)
        looking = Looking(at)
        options = RunOptions(settings=learning, engine=at.name, device=at.device, look=looking)
        summary = run(command, options)
    assert summary.model_before is not None  # the host saves at its last iteration
    assert summary.model_after is not None
    pair = summary.model_before, summary.model_after
    with _timed(seconds, "control"), claiming(out, "model"):
        say(f"2/4  The control: the same {settings.finetune} iterations without cutoffs")
        zero = _control(command, options)
    with _timed(seconds, "measure"):
        say("3/4  Measuring on the held-out views")
        loaded = (models.load(path, device=settings.device) for path in (*pair, zero))
        candidates = [Candidate(each) for each in loaded]
        report = _measure(scene, candidates, settings, summary, looking.trial)
    with _timed(seconds, "pictures"), claiming(out, "pictures", "index.html", "model"):
        say("4/4  Drawing the pictures")
        report["files"] = write_page(
            out, report, scene, summary.curves, settings.engine, settings.device
        )
        read = Recorded(Photographs(scene), pair, filtered=True, drawing=summary.drawing)
        more = {"curves": summary.curves, "photographs": read.as_dict()}
        records.leave(summary.model_after, "run", report | more)  # as of run, for report
    report |= {"seconds_by_part": seconds, "seconds": sum(seconds.values())}
    with claiming(out, REPORT), replacing(out / REPORT) as path:
        path.write_text(json.dumps(report, indent=2) + "\n", encoding="utf-8")
    return report


def _control(command: list[str], options: RunOptions) -> Path:
    """The model that the host's stage 2 gives from the same checkpoint without cutoffs."""
    settings = replace(options.settings, goal=Control())
    with contextlib.redirect_stdout(sys.stderr):
        summary = run(command, replace(options, stage="finetune", settings=settings, look=None))
    assert summary.model_after is not None
    return summary.model_after


def _measure(
    scene: Path,
    candidates: list[Candidate],
    settings: DemoSettings,
    summary: RunSummary,
    trial: Trial | None,
) -> dict[str, Any]:
    """Figures of the original, the pruned model and the control, on held-out views."""
    shots = load_dataset(scene).test
    before, after, zero = measure_all(candidates, shots, engine=settings.engine, repeats=_REPEATS)
    return {
        "before": before,
        "after": after,
        "control": zero,
        "keep": trial and trial.keep,
        "forgotten": trial and trial.forgotten,
        "engine": after["engine"],
        "device": after["device"],
        "iterations": summary.steps,
        "train_seconds": summary.train_seconds,
        "adapter": summary.adapter,
        "seed": settings.seed,
        "model_before": str(summary.model_before),
        "model_after": str(summary.model_after),
        "settings": summary.settings,
    }


@contextlib.contextmanager
def _timed(seconds: dict[str, float], part: str) -> Iterator[None]:
    """Add the wall time of a block, as that of a part."""
    started = time.perf_counter()
    yield
    seconds[part] = round(time.perf_counter() - started, 3)


def write_page(
    out: Path,
    report: dict[str, Any],
    scene: Path,
    curves: list[dict[str, float]],
    engine: str,
    device: str,
) -> list[str]:
    """Write ``pictures/`` and ``index.html``.

    Args:
        report: the measurements; "larger" is added, frame times of pictures as large as the page's.

    Returns:
        The files as paths relative to ``out``.
    """
    pictures = out / "pictures"
    paths = (Path(report["model_before"]), Path(report["model_after"]))
    one, other = (models.load(path, device=device) for path in paths)
    original, pruned = Candidate(one.untruncated()), Candidate(other)
    shots = sorted(load_dataset(scene).test, key=lambda shot: shot.name != _FIRST)
    rasterizer = engine_for(engine, device)
    views = [enlarged(shot.view, LARGER).to(device) for shot in shots]
    times = frame_times([original, pruned], views, rasterizer, repeats=_REPEATS)
    size = f"{views[0].width}x{views[0].height}"
    report["larger"] = {"size": size, "before": times[0], "after": times[1]}
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
        facts=headlines(report, report["control"]),
        quote=outcome("run", report, report["control"]),
        seen=False,
        notes=begun(report),
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
