"""Runs a host's command in this process, with a session around it.

A training run has two halves. Stage 1 is the host's own training, untouched but for being asked to
write its checkpoint at the end. Stage 2 is the host's own script again, resumed from that
checkpoint for more iterations, with thresholds.
"""

from __future__ import annotations

import contextlib
import logging
import sys
import tempfile
import time
from dataclasses import dataclass, field, replace
from functools import partial
from pathlib import Path
from typing import Any, Literal

from fragprune_plugins.datasets.photographs import Photographs
from fragprune_plugins.errors import (
    HostFailed,
    Interrupted,
    NotComparedError,
    Terminated,
    UsageError,
)
from fragprune_plugins.hosts import preflight
from fragprune_plugins.hosts.adapter import ScriptAdapter
from fragprune_plugins.hosts.choosing import choose, locate
from fragprune_plugins.hosts.source import HostRepo
from fragprune_plugins.injection import process, starting
from fragprune_plugins.injection.command import HostCommand, split
from fragprune_plugins.injection.starting import Start
from fragprune_plugins.learning.events import Summary
from fragprune_plugins.learning.interruption import Terminate, sigterm_interrupts
from fragprune_plugins.learning.schedule import JointSchedule, Settings
from fragprune_plugins.plugins.loading import installed

log = logging.getLogger("fragprune")

Stage = Literal["auto", "finetune", "joint", "off"]


@dataclass(frozen=True)
class RunOptions:
    """How to run a host.

    Attributes:
        adapter: name, or None to detect it from the source.
        stage: "auto" trains and then fine-tunes; "finetune" resumes what the output folder (or
            ``--start_checkpoint``) holds; "joint" learns inside the host's training; "off" only
            applies thresholds that are there.
        settings: of the fine-tuning.
        from_iter: with "finetune": learn and freeze from this iteration of a run that was not
            resumed; with "joint": learn from it.
        alternate: with "joint", learn for so many iterations, hold for as many, and so on.
        engine: "auto", "reference", "cpu", "cuda", or the name of a plugin's.
        device: where the host runs: "cpu" lets a CUDA-only host do without a GPU, "cuda" and
            "cuda:N" insist on one, "auto" takes a GPU where torch sees one.
    """

    adapter: str | None = None
    stage: Stage = "auto"
    settings: Settings = field(default_factory=Settings)
    from_iter: int | None = None
    alternate: int | None = None
    engine: str = "auto"
    device: str = "auto"


@dataclass(frozen=True)
class RunSummary:
    """What a run did.

    Attributes:
        adapter: its name.
        engine: that drew stage 2, "" when there was none.
        device: "cpu", "cuda" or "cuda:N".
        stage: what was asked for.
        iterations: learned in stage 2.
        gaussians: of the trained model.
        fragments_before: per pixel over training views, untruncated.
        fragments_after: per pixel over training views, at each view's last visit.
        model_before: the host's PLY of stage 1, when there is one.
        model_after: the host's PLY after stage 2; its sidecar lies beside it.
        output: the host's folder, that of stage 1 where stage 2 has another.
        train_seconds: wall time of both stages.
        target_reached: whether a target speed-up was met within 5% on training views; None
            without a target.
        curves: a dict per learned step: step, loss, fragments_per_pixel, pressure,
            threshold_median.
        settings: of the fine-tuning.
        photographs: by whose held-out views both models can be measured; None where they cannot.
        drawing: fields of ``RasterInputs`` by which the host draws its models.
        not_compared: why they cannot, where something was learned.
    """

    adapter: str
    engine: str
    device: str
    stage: str
    iterations: int
    gaussians: int
    fragments_before: float | None
    fragments_after: float | None
    model_before: Path | None
    model_after: Path | None
    train_seconds: float
    target_reached: bool | None
    curves: list[dict[str, float]]
    settings: dict[str, Any]
    output: Path | None = None
    photographs: Photographs | None = None
    drawing: dict[str, Any] = field(default_factory=dict)
    not_compared: NotComparedError | None = None


def run(command: list[str], options: RunOptions | None = None) -> RunSummary:
    """Run a host's command with fragment pruning.

    Args:
        command: as typed, ``["python", "train.py", "-s", "scene", ...]``; a leading python may be
            left out.
        options: how.

    Raises:
        UsageError: the command names no script, or there is no such device.
        EngineError: no such engine here.
        UnknownHostError: no adapter fits the script's folder.
        HostNeedsError: packages that the script imports, or its data, are missing.
        HostFailed: the host raised, or ended with an error code.
        Interrupted: Ctrl-C in stage 2, or (Terminated) SIGTERM; what was learned has been saved.
        DivergedError: NaN or infinity in stage 2, of which nothing has been saved.
    """
    from fragprune_plugins.plugins.hooks import engine_for, select_adapter

    options = options or RunOptions()
    script, arguments, module = split(command)
    plugins = installed()
    tie = partial(select_adapter, plugins=plugins)
    top = module.split(".")[0]
    package = HostRepo.installed(top) if module else None
    if package is not None and script.is_relative_to(package.root / top):
        repo, adapter = package, choose(package, plugins.adapters, options.adapter, select=tie)
    else:
        repo, adapter = locate(script.parent, plugins.adapters, options.adapter, select=tie)
    if not isinstance(adapter, ScriptAdapter):
        raise UsageError(
            "fragprune run",
            f"{adapter.info.title}, a library without a training command",
            adapter.use(repo),
            f"See the how-to page of {adapter.name}.",
        )
    host = HostCommand.read(script, arguments, adapter.command_line(repo), module)
    device = process.host_device(options.device, options.engine)
    if options.engine != "auto":
        engine_for(options.engine, device, plugins)  # refuse before stage 1
    started = time.perf_counter()
    trains = script in (repo.root / name for name in host.line.scripts)
    dialect = adapter.dialect(repo)
    answered = {*dialect.names(), *(dialect.spares() if device == "cpu" else ())}
    data = Path(host.flags.source) if trains and host.flags.source else None
    preflight.expect(repo, script, answered, data)
    with tempfile.TemporaryDirectory(prefix="fragprune-") as scratch:
        runner = _Runner(host, repo, adapter, plugins, options, device, Path(scratch))
        if not trains or options.stage == "off":
            runner.observe()
        elif options.stage == "joint":
            runner.joint()
        elif options.stage == "finetune":
            runner.finetune()
        else:
            runner.train_then_finetune()
    return runner.summary(time.perf_counter() - started)


class _Runner:
    """One command's stages; holds what the summary needs."""

    def __init__(
        self,
        host: HostCommand,
        repo: HostRepo,
        adapter: ScriptAdapter,
        plugins: Any,
        options: RunOptions,
        device: str,
        scratch: Path,
    ) -> None:
        self.host, self.repo, self.adapter, self.plugins = host, repo, adapter, plugins
        self.options, self.device, self.scratch = options, device, scratch
        self.output = host.output
        self.around: Path | None = None  # of stage 1, where stage 2 has a folder of its own
        self.trained: Start | None = None  # stage 1's end, once it is over
        self.before: Path | None = None
        self.after: Path | None = None
        self.learned: Summary | None = None
        self.curves: list[dict[str, float]] = []

    def observe(self) -> None:
        """The command as it is; thresholds of sidecars are applied."""
        self._execute(self.host.arguments, learn=False)

    def joint(self) -> None:
        """Thresholds learn beside everything else."""
        resumed, start, total = self._learning(self.options.from_iter)
        steps = total - resumed - self.host.line.skipped
        settings = replace(self.options.settings, iterations=steps)
        schedule = JointSchedule(settings, max(1, start - resumed), self.options.alternate)
        self._execute(
            self.host.saving(self.scratch, total),
            learn=True,
            freeze=False,
            start=resumed,
            schedule=schedule,
            settings=settings,
        )
        self.after = self._model(total)

    def train_then_finetune(self) -> None:
        """Stage 1 with a checkpoint at its end, then stage 2 from there."""
        if self.host.flags.resume and self.host.script.name not in self.host.line.continues:
            return self.finetune()
        self.adapter.resumed_by(self.host.script, self.host.arguments)  # refuse before stage 1
        total = self.host.iterations
        log.info("stage 1: the host's own training, %d iterations", total)
        checkpoints = self.host.checkpoints(total)
        arguments = self.host.with_flags(self.scratch, save_checkpoints=checkpoints)
        files = starting.files(self.adapter, self.output)
        earlier = {path: path.stat().st_mtime_ns for _, path in files}
        self._execute(arguments, learn=False)
        ends = [
            (path.suffix != ".ply", path)
            for iteration, path in starting.files(self.adapter, self.output)
            if iteration == total and earlier.get(path) != path.stat().st_mtime_ns
        ]
        if not ends:  # hosts refuse with exit code 0 too
            raise HostFailed(
                self.host.script.name,
                f"ended without a checkpoint of iteration {total}",
                "its own training to come to its end",
                "Read the host's own message above.",
            )
        self.trained = Start(total, max(ends)[1], "the end of stage 1")
        self.finetune()

    def finetune(self) -> None:
        """Stage 2: resume, or wait for ``from_iter`` inside one run."""
        settings = self.options.settings
        if self.options.from_iter is not None:
            resumed, begins, total = self._learning(self.options.from_iter)
            steps = total - begins - self.host.line.skipped
            self._execute(
                self.host.saving(self.scratch, total),
                learn=True,
                from_step=begins - resumed,
                start=resumed,
                settings=replace(settings, iterations=steps),
            )
            self.after = self._model(total)
            return
        self.host = self.host.of(*self.adapter.resumed_by(self.host.script, self.host.arguments))
        self.output = self.output or self.host.output
        start = self.trained or starting.find(self.adapter, self.host, self.output)
        log.info("stage 2: %d iterations from iteration %d, %s: %s", settings.iterations, *start)
        line = self.host.line
        with starting.resumable(self.adapter, line, start) as checkpoint:
            self.before = self._model(start.iteration)
            first = 0 if line.restarts else start.iteration
            total = first + settings.iterations + line.skipped
            extra = {"iterations": total, "resume": str(checkpoint)}
            own = "finetuned" if line.restarts else ""
            own = own if settings.truncate else "control"  # what was learned stays where it is
            if own and self.output is not None:
                self.around, self.output = self.output, self.output / own
            if self.output is not None and str(self.output) != self.host.flags.output:
                extra["output"] = str(self.output)
            arguments = self.host.saving(self.scratch, total, **extra)
            self._execute(arguments, learn=True, start=first)
            self.after = self._model(total)

    def _execute(
        self,
        arguments: list[str],
        *,
        learn: bool,
        settings: Settings | None = None,
        **options: Any,
    ) -> None:
        """The host's script with these arguments, in a session with these options."""
        from fragprune_plugins.injection.session import Session

        session = Session(
            self.adapter,
            self.repo,
            self.plugins,
            settings or self.options.settings,
            learn=learn,
            engine=self.options.engine,
            drop_in=True if self.device == "cpu" else None,
            output=self.output,
            origin=self.around,
            **options,
        )
        known = set(sys.modules)
        host = self.host
        try:
            with contextlib.ExitStack() as stack:
                stack.enter_context(process.telling(host.script, self.repo.root))
                stack.enter_context(session)
                folder = Path.cwd() if host.module else host.script.parent
                stack.enter_context(
                    process.host_process(host.script, arguments, self.device, folder)
                )
                if learn:
                    stack.enter_context(sigterm_interrupts())
                try:
                    process.run_main(host.script, host.module)
                except KeyboardInterrupt as error:  # here, where saving still writes the sidecar
                    saved = session.save_interrupted() if learn else None
                    raise self._interrupted(error, saved) from error
            session.expect_drawn()
        finally:
            self.output = session.output or self.output
            process.forget_modules(self.repo.root, known, self.adapter.installed)
            if learn:
                self.learned = session.finish()
                self.curves = session.curves

    def _interrupted(self, error: KeyboardInterrupt, saved: Path | None) -> Interrupted:
        """What to say of Ctrl-C or SIGTERM, and of what was saved then."""
        by_signal = isinstance(error, Terminate)
        stated, found = (Terminated, "SIGTERM") if by_signal else (Interrupted, "Ctrl-C")
        again = "Start it again."
        if saved:
            found += f"; thresholds so far are beside {saved}"
            again = (
                "Go on from there with fragprune run --stage finetune and "
                f"{self.host.line.spellings('resume')[-1]} {saved} in the host's command; without, "
                "stage 2 begins anew."
            )
        return stated(self.host.script.name, found, "the run to end", again)

    def summary(self, seconds: float) -> RunSummary:
        """Everything the command line prints."""
        learned = self.learned
        photographs, drawing, not_compared = self._comparison()
        return RunSummary(
            adapter=self.adapter.name,
            engine=learned.engine if learned else "",
            device=self.device,
            stage=self.options.stage,
            iterations=learned.steps if learned else 0,
            gaussians=learned.gaussians if learned else 0,
            fragments_before=learned.fragments_before if learned else None,
            fragments_after=learned.fragments_after if learned else None,
            model_before=self.before,
            model_after=self.after,
            train_seconds=seconds,
            target_reached=learned.target_reached if learned else None,
            curves=self.curves,
            settings=self.options.settings.as_dict(),
            output=self.around or self.output,
            photographs=photographs,
            drawing=drawing,
            not_compared=not_compared,
        )

    def _comparison(self) -> tuple[Photographs | None, dict[str, Any], NotComparedError | None]:
        """By which views and how before and after are drawn, or why they cannot be."""
        if not self.learned:
            return None, {}, None
        try:
            if not (self.before and self.after):
                raise NotComparedError(
                    f"--stage {self.options.stage}",
                    f"no model of {'before' if self.after else 'after'} the learning",
                    "one that the host saved",
                    "Name two models to fragprune compare.",
                )
            drawing = self.adapter.drawing(self.repo, self.host.arguments)
            return self.adapter.photographs(self.repo, self.host.arguments), drawing, None
        except NotComparedError as error:
            return None, {}, error

    def _learning(self, from_iter: int | None) -> tuple[int, int, int]:
        """Iterations of the host: the one this run goes on after, where learning begins, the last.

        Args:
            from_iter: as asked for; half of the training where it is not.

        Raises:
            UsageError: nothing would be learned.
        """
        total, file = self.host.iterations, self.host.flags.resume
        resumed = starting.resumed_at(self.host.line, Path(file)) if file else 0
        start = max(resumed, total // 2 if from_iter is None else from_iter)
        if start < total - self.host.line.skipped:
            return resumed, start, total
        flag = f"Raise {self.host.line.spellings('iterations')[-1]}"
        raise UsageError(
            f"--stage {self.options.stage}",
            f"iterations {resumed + 1} to {total}" if resumed < total else "no iterations",
            f"some after {start}, where learning begins",
            f"{flag}, or lower --from-iter." if start > resumed else f"{flag}.",
        )

    def _model(self, iteration: int) -> Path | None:
        """The host's PLY of an iteration, if it saved one."""
        path = self.adapter.model_file(self.output, iteration) if self.output else None
        return path if path and path.exists() else None
