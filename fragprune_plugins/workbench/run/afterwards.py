"""A host that no adapter fits: it trains as it is, and its plain PLY is fine-tuned afterwards."""

from __future__ import annotations

import contextlib
import re
import subprocess
import sys
import time
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

from fragprune_plugins.errors import DatasetError, HostFailed, UsageError, log
from fragprune_plugins.hosts.adapter import Flags
from fragprune_plugins.hosts.choosing import attempt, folder_above
from fragprune_plugins.hosts.photographs import Photographs
from fragprune_plugins.hosts.source import HostRepo
from fragprune_plugins.injection.command import split
from fragprune_plugins.learning.interruption import Terminate, sigterm_interrupts
from fragprune_plugins.learning.schedule import QUICK_ITERATIONS, Settings
from fragprune_plugins.plugins.loading import load_plugins
from fragprune_plugins.workbench.commands.command import Report
from fragprune_plugins.workbench.commands.options import EngineOptions, SceneOptions
from fragprune_plugins.workbench.finetune.work import finetune
from fragprune_plugins.workbench.ranks import launched
from fragprune_plugins.workbench.saved import models_of
from fragprune_plugins.workbench.scenes.dataset import read_scene
from fragprune_plugins.workbench.scenes.output import cameras_of, told_by, trained_on
from fragprune_plugins.workbench.scenes.training import exposed

_BY_HAND = "fragprune finetune MODEL.ply --data SCENE --out pruned.ply learns on any that is there."


@dataclass(frozen=True)
class Unserved:
    """A training command of a codebase that no adapter fits, and whose PLY is plain 3DGS.

    Attributes:
        program: the words of the command that name what the interpreter runs.
        arguments: those after them.
        output: the folder that it names as 3DGS does; None if it names none.
        photographs: likewise, and how it reads them.
        why: what speaks against the nearest adapter.
        unlike: why its model's pictures may differ from the photographs; see ``Plain``.
    """

    program: tuple[str, ...]
    arguments: tuple[str, ...]
    output: Path | None
    photographs: Photographs | None
    why: str
    unlike: str = ""

    def train(self, *, quietly: bool) -> None:
        """Run the command in a process of its own; with ``quietly`` it prints to stderr."""
        words = [sys.executable, *self.program, *self.arguments]
        with sigterm_interrupts(), subprocess.Popen(words, stdout=2 if quietly else None) as host:
            try:
                code = host.wait()
            except KeyboardInterrupt as signal:  # a terminal sends it to the host, too
                if isinstance(signal, Terminate):
                    host.terminate()
                host.wait()
                raise
        if code:
            remedy = "No adapter serves it, so it trains by its own rasterizer alone. Look above."
            raise HostFailed(self.program[-1], f"exit code {code}", "a training to its end", remedy)

    def saved(self, since: float) -> Path:
        """The PLY that it wrote last, since a time; what it makes of one lies in folders below it.

        Another folder than the one that it names may be another training's.
        """
        folder = self.output or Path.cwd()
        found = [each for each in folder.rglob("point_cloud.ply") if each.stat().st_mtime >= since]
        if not found:
            what = f"no point_cloud.ply in {folder}" + (" since it began" if since else "")
            raise HostFailed(self.program[-1], what, "the model that it trained", _BY_HAND)
        return max(found, key=lambda each: (-len(each.parts), each.stat().st_mtime))


def unserved(command: Sequence[str]) -> Unserved | None:
    """The command, if it trains, no adapter fits its codebase, and that saves plain 3DGS."""
    script, arguments, module = split(list(command))
    here, plugins = HostRepo(script.parent), load_plugins()
    trains = "train" in script.stem or ".backward(" in here.read(script)
    folders = [here, *folder_above(here)] if trains else []
    found = ((each, models_of(each, plugins)[0]) for each in folders)
    repo, own = next((pair for pair in found if pair[1]), (here, None))
    models = set(re.findall(r"\b\w*GaussianModel\w*", here.read(script)))
    if own is None or (models and own.model not in models):  # another may save other columns
        return None
    tried = attempt(repo, plugins.adapters)
    if any(match.fits for match in tried.values()):
        return None
    program = ("-m", module) if module else (str(script),)
    parser = Flags(add_help=False, allow_abbrev=False)
    parser.add_argument("-m", "--model_path", type=Path)
    parser.add_argument("-s", "--source_path")
    parser.add_argument("-i", "--images", default="images")
    parser.add_argument("-r", "--resolution", type=float, default=-1)
    parser.add_argument("-w", "--white_background", action="store_true")
    flags = vars(parser.parse_known_args(arguments)[0])
    photographs = told_by(flags) if flags["source_path"] else None
    why = next(iter(tried.values())).brief() if tried else "none is installed"
    output = flags["model_path"]
    return Unserved(program, tuple(arguments), output, photographs, why, own.unlike)


def train_then_finetune(
    host: Unserved,
    stage: str,
    settings: Settings,
    engine: EngineOptions,
    *,
    again: bool,
    json: bool,
) -> Report:
    """Train by the command alone, then do what ``fragprune finetune`` does with its PLY.

    Args:
        stage: "auto", or "finetune" for a host that has trained already.
        json: stdout gets our object only.
    """
    if launched().several:
        raise UsageError(
            "run", "several processes", "one, for a codebase that no adapter fits", _BY_HAND
        )
    settings = _settings_of(host.unlike, settings)
    log.info("no adapter fits (%s), but its PLY is plain 3DGS", host.why)
    photographs, since = host.photographs, 0.0
    if photographs is not None:  # better now than after a training
        read_scene(photographs.folder, photographs.images)
    if stage == "auto":
        since = time.time() - 1  # file systems round
        log.info("it trains as it is, by itself")
        host.train(quietly=json)
    elif host.output is None:
        remedy = "Add -m FOLDER, also if the training knows no -m: it is not started again."
        raise UsageError("command", "no -m", "the output folder of the training", remedy)
    model = host.saved(since)
    if not host.unlike and (name := exposed(model)):
        settings = _settings_of(f"it learned an exposure for {name}", settings)
    out = model.with_name("pruned.ply" if settings.goal.presses else "control.ply")
    log.info("%s learns by vanilla 3DGS's drawing and loss, as in fragprune finetune", model)
    photographs, scene = _scene_of(model, photographs, settings)
    report = finetune(
        model=model,
        out=out,
        itself=settings.itself,
        scene=scene,
        settings=settings,
        seed=settings.seed,
        again=again,
        engine=engine,
        command="run",
        photographs=photographs,
    )
    assert report is not None
    host_data = {"stage": stage, "model_before": str(model), "model_after": str(out)}
    return replace(report, data=report.data | host_data)


def _scene_of(
    model: Path, photographs: Photographs | None, settings: Settings
) -> tuple[Photographs | None, SceneOptions]:
    """The photographs of a model's training, by what it wrote or else these, and its cameras."""
    with contextlib.suppress(DatasetError):  # what it wrote as its arguments may be anything
        photographs = trained_on(model) or photographs
    if photographs is None:
        return None, SceneOptions()
    data = None if settings.itself and cameras_of(model) else photographs.folder
    if not settings.itself:
        log.info("from the photographs in %s", data)
    return photographs, SceneOptions(data, white_background=photographs.white_background)


def _settings_of(unlike: str, settings: Settings) -> Settings:
    """Those of a model that learns from its own pictures, where photographs show something else."""
    if not unlike:
        return settings
    if not settings.goal.presses:
        expected = "something to learn: its own pictures are the target of this model already"
        raise UsageError("--control", unlike, expected, "Leave it out.")
    log.info("it learns from its own pictures, not from photographs: %s", unlike)
    iterations = min(settings.iterations, QUICK_ITERATIONS)
    return replace(settings, itself=True, iterations=iterations)
