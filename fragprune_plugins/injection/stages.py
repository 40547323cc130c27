"""The stages of a run.

Stage 1 is the host's own training; fragprune only adds the flag that saves a checkpoint at its end.
Stage 2 runs the host's script again, from that checkpoint for more iterations: thresholds learn.
"""

from __future__ import annotations

import contextlib
import gc
import sys
import time
from collections.abc import Callable
from dataclasses import dataclass, field, replace
from functools import partial
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from fragprune_plugins.errors import (
    HostFailed,
    Interrupted,
    NotComparedError,
    SidecarError,
    Terminated,
    UsageError,
    log,
)
from fragprune_plugins.files import sidecar
from fragprune_plugins.hosts.adapter import ScriptAdapter
from fragprune_plugins.hosts.photographs import Photographs
from fragprune_plugins.hosts.seams import Seam
from fragprune_plugins.hosts.source import HostRepo
from fragprune_plugins.injection import process, starting, workers
from fragprune_plugins.injection.command import HostCommand
from fragprune_plugins.injection.options import RunOptions, RunSummary
from fragprune_plugins.injection.rasterizing import directly
from fragprune_plugins.injection.session import Session
from fragprune_plugins.injection.starting import Start
from fragprune_plugins.learning.events import Summary
from fragprune_plugins.learning.interruption import Terminate, sigterm_interrupts
from fragprune_plugins.learning.schedule import JointSchedule, Settings
from fragprune_plugins.plugins.loading import Plugins

_STAYING = 0.9  # of the Gaussians: at the end of an iteration 3DGS-MCMC moves some that show little


@dataclass
class Stages:
    """Runs the stages of one command and keeps the figures for the summary."""

    host: HostCommand
    repo: HostRepo
    adapter: ScriptAdapter
    plugins: Plugins
    options: RunOptions
    device: str
    scratch: Path
    around: Path | None = None  # stage 1's folder, if stage 2 has its own
    start: Start | None = None  # of stage 2
    before: Path | None = None
    after: Path | None = None
    learned: Summary | None = None
    curves: list[dict[str, float]] = field(default_factory=list)
    unproved: set[Seam] = field(default_factory=set)  # rasterizers of which that was said
    already_finished: bool = False

    def __post_init__(self) -> None:
        self.output, self.settings = self.host.output, self.options.settings  # those of stage 2

    def observe(self) -> None:
        """Run the command unchanged; thresholds of sidecars apply, and nothing learns."""
        self._execute(self.host.arguments, learn=False)

    def joint(self) -> None:
        """Run the command once; thresholds learn while the whole model trains."""
        host, from_iter = self.host, self.options.from_iter
        if from_iter is None:
            from_iter = self.adapter.densified(self.repo, host.script, host.arguments)
        if from_iter is None:
            found = f"{self.adapter.info.title}, which does not tell when its densification is over"
            expected = "the iteration after which thresholds learn"
            raise UsageError("--stage joint", found, expected, "Add --from-iter.")
        self._learn_within(from_iter, joint=True)

    def train_then_finetune(self) -> None:
        """Run stage 1 with a checkpoint at its end, then stage 2 from that checkpoint."""
        if self.host.line.one_run:
            return self.one_run()
        if self.host.flags.resume and not starting.trains_on(self.host):
            return self.finetune()
        self.adapter.resumed_by(self.host.script, self.host.arguments)  # refuse before stage 1
        if not self.options.again:
            self.start = starting.finished(self.adapter, self.host, self.repo.commit)
        if self.start is None:
            self.start = self._train()
            starting.remember(self.start, self.host, self.repo.commit)
        self.finetune()

    def _train(self) -> Start:
        """Run stage 1; returns its end."""
        total = self.host.iterations
        log.info("stage 1: the host's own training, %d iterations", total)
        written = self.host.checkpoints(total)
        arguments = self.host.with_flags(self.scratch, save_checkpoints=written)
        files = starting.files(self.adapter, self.output)
        earlier = {path: path.stat().st_mtime_ns for _, path in files}

        def end() -> Path | None:
            ends = [
                (path.suffix != ".ply", path)
                for iteration, path in starting.files(self.adapter, self.output)
                if iteration == total and earlier.get(path) != path.stat().st_mtime_ns
            ]
            return max(ends)[1] if ends else None

        try:
            self._execute(arguments, learn=False)
        except HostFailed as error:
            if (saved := end()) is None or not starting.whole(saved):
                raise
            said = "the host had saved %s when it failed, and stage 2 goes on: %s"
            log.warning(said, saved, str(error))
        gc.collect()  # the error held the host's frames, and so its socket and its model
        if (saved := end()) is None:  # some hosts refuse a command with exit code 0
            found = f"ended without a checkpoint of iteration {total}"
            expected = "a training that runs to its end"
            raise HostFailed(self.host.script.name, found, expected, process.READ)
        return Start(total, saved, "the end of stage 1")

    def one_run(self) -> None:
        """Run a host that cannot resume once, longer; stage 2 begins where it would have ended."""
        settings, total = self.options.settings, self.host.iterations
        last = total + settings.iterations + self.host.line.skipped
        log.info("one run of %d iterations; stage 2 begins after %d", last, total)
        arguments = self.adapter.lengthened(self.host.arguments, total, last)
        for folder in self._apart().values():
            arguments += [self.host.line.output[-1], folder]
        look = partial(self._look_within, total) if self.options.look else None
        self._learn(last, arguments, from_step=total, settings=settings, look=look)
        self.before = self._model(total)

    def finetune(self) -> None:
        """Run stage 2: resume a model, or begin at ``from_iter`` of one run."""
        settings = self.options.settings
        if self.options.from_iter is not None:
            return self._learn_within(self.options.from_iter)
        if self.host.line.one_run:
            if not settings.goal.presses:  # a control trains as long as the run that it is for
                return self.one_run()
            found = f"{self.host.script.name}, which cannot resume a training"
            expected = "--from-iter, the iteration of one run after which stage 2 begins"
            remedy = "Add it, or give the trained PLY to fragprune finetune."
            raise UsageError("--stage finetune", found, expected, remedy)
        if not settings.goal.presses:  # a control begins where what it is for did
            self.start = self.start or starting.ended(self.adapter, self.host)
        self.host = self.host.of(*self.adapter.resumed_by(self.host.script, self.host.arguments))
        self.output = self.output or self.host.output
        start = self.start = self.start or starting.find(self.adapter, self.host, self.output)
        log.info("stage 2: %d iterations from iteration %d, %s: %s", settings.iterations, *start)
        line = self.host.line
        with starting.resumable(self.adapter, line, start) as checkpoint:
            self.before = self._model(start.iteration, at=start.path)
            first = 0 if line.restarts else start.iteration
            total = first + settings.iterations + line.skipped
            apart = self._apart("finetuned" if line.restarts else "")
            extra: dict[str, Any] = {"iterations": total, **apart}
            known = None if self.options.again else self._finished(start, self._model(total))
            if known is not None:
                self.settings, self.after, self.already_finished = known, self._model(total), True
                return
            self.settings, resumed = self._look(checkpoint, start.iteration)
            extra["resume"] = str(resumed)
            arguments = self.host.saving(self.scratch, total, **extra)
            self._learn(total, arguments, settings=self.settings, start=first, origin=start.path)

    def _apart(self, own: str = "") -> dict[str, str]:
        """Give what learns a folder of its own, a control always; returns the host's flag."""
        own = own if self.options.settings.goal.presses else "control"
        if own and self.output is not None:
            self.around, self.output = self.output, self.output / own
        return {} if self.output == self.host.output else {"output": str(self.output)}

    def _learn(self, last: int, arguments: list[str], **options: Any) -> None:
        """Run the host's script with learning on; the result is its model of iteration ``last``."""
        started = time.time() - 0.1  # a file has the time of the last tick of the clock
        kept = partial(self._model, last, started)

        def ended(session: Session) -> None:
            unsaved = session.held is not None and not kept()
            if unsaved and (path := session.save_learned(last)):
                log.warning("the host saved no model of its last iteration: saved %s", path)

        try:
            self._execute(arguments, learn=True, ended=ended, kept=kept, **options)
        except HostFailed as error:
            if (path := kept()) is None:
                raise
            remedy = f"{error.remedy} The learned model was saved: {path}"
            raise HostFailed(error.where, error.found, error.expected, remedy) from error
        self.after = self._model(last)

    def _look(self, resumed: Path, iteration: int) -> tuple[Settings, Path]:
        """What a look at the model of stage 1 gives, and the file to resume with what it keeps."""
        own = self.scratch / "whole" / resumed.name

        def ready(before: Path) -> None:
            nonlocal resumed
            if not starting.holds(resumed, before):
                own.parent.mkdir(exist_ok=True)
                self.adapter.checkpoint_from_ply(before, iteration, own)
                log.info("from %s instead: its iteration changed Gaussians after that", before)
                resumed = own

        settings, kept = self._looked(self.before, ready)
        return settings, starting.part_of(resumed, kept, self.scratch)

    def _look_within(self, iteration: int, model: Any) -> tuple[Settings, Tensor | None]:
        """The same in one run, in which the host trains on."""
        means = self.adapter.means(model).detach()

        def ready(before: Path) -> None:
            known = before.suffix == ".ply" and starting.same_means(before, [means.cpu()], _STAYING)
            if not known:
                found, expected = "other Gaussians than those that train", "a PLY of the same"
                raise NotComparedError(str(before), found, expected, "")

        # torch's fork_rng would remember, for the whole process, that a host's cuda is the CPU.
        numbers = torch.cuda if means.is_cuda else torch
        states = torch.get_rng_state(), numbers.get_rng_state()
        with directly(means.device):
            self.settings, kept = self._looked(self._model(iteration), ready)
        torch.set_rng_state(states[0])
        numbers.set_rng_state(states[1])
        return self.settings, kept if kept is None else kept.to(means.device)

    def _looked(
        self, before: Path | None, ready: Callable[[Path], None]
    ) -> tuple[Settings, Tensor | None]:
        """What a look at a PLY gives, if it is ``ready``; else the settings that were asked for."""
        settings, host = self.options.settings, (self.repo, self.host.arguments)
        if self.options.look is None or before is None:
            return settings, None
        try:
            photographs, drawing = self.adapter.photographs(*host), self.adapter.drawing(*host)
            ready(before)
            return self.options.look(before, photographs, drawing, settings)
        except (NotComparedError, UsageError) as error:
            why = f"{error.where}: {error.found}"
        log.warning("stage 2 learns as asked, without a look at the model: %s", why)
        return settings, None

    def _execute(
        self,
        arguments: list[str],
        *,
        learn: bool,
        settings: Settings | None = None,
        ended: Callable[[Session], None] = lambda _: None,
        kept: Callable[[], Path | None] = lambda: None,
        look: Callable[[Any], tuple[Settings, Tensor | None]] | None = None,
        **options: Any,
    ) -> None:
        """Run the host's script in a session with these options; ``ended`` gets it at its end."""
        session = Session(
            self.adapter,
            self.repo,
            self.plugins,
            settings or self.options.settings,
            learn=learn,
            engine=self.options.engine,
            drop_in=True if self.device == "cpu" else None,
            prove=self.options.stage != "off",
            trust=self.options.trust,
            output=self.output,
            **options,
        )
        session.unproved, session.look = self.unproved, look
        known, host = set(sys.modules), self.host
        folder = Path.cwd() if host.module else host.script.parent
        try:
            with (
                process.telling(host.script, self.repo.root),
                session,
                process.host_process(host.script, arguments, self.device, folder),
                workers.prepared(session, self.device),
                sigterm_interrupts() if learn else contextlib.nullcontext(),
            ):
                try:
                    process.run_main(host.script, host.module)
                    ended(session)
                except KeyboardInterrupt as error:  # the session still writes sidecars
                    if isinstance(error, Terminate) or not kept():  # else it closes a viewer
                        saved = session.save_learned() if learn else None
                        raise self._interrupted(error, saved) from error
            session.expect_drawn()
        finally:
            self.output = session.output or self.output
            process.forget_modules(self.repo.root, known, self.adapter.installed)
            gc.collect()  # closes objects of module globals, such as the viewer's socket
            if learn:
                self.learned = session.finish()
                self.curves = session.curves

    def _finished(self, start: Start, result: Path | None) -> Settings | None:
        """With what stage 2 wrote this file from this start, if that is what is asked for."""
        if result is None or start.path.stat().st_mtime_ns > result.stat().st_mtime_ns:
            return None
        try:
            _, info = sidecar.load(result)
        except SidecarError:
            return None
        settings = self.options.settings
        if settings.dropout is None:  # a look at the model chose it
            settings = replace(settings, dropout=info.settings.get("dropout"))
        asked = settings.as_dict(), self.adapter.name, self.repo.commit
        written = info.settings, info.adapter, info.host_commit
        return settings if written == asked else None

    def _interrupted(self, error: KeyboardInterrupt, saved: Path | None) -> Interrupted:
        """The error for Ctrl-C or SIGTERM: it names what was saved, and says how to go on."""
        by_signal = isinstance(error, Terminate)
        stated, found = (Terminated, "SIGTERM") if by_signal else (Interrupted, "Ctrl-C")
        remedy = "Run the command again."
        line = self.host.line
        if self.start is not None:
            named = self.host.output is not None
            added = "" if named else f" with --stage finetune and {line.output[-1]} {self.output}"
            remedy = f"Run the command again{added}: stage 2 begins anew from {self.start.path}."
        if saved:
            portable = self.options.settings.goal.on_area
            learned, where = ("model", "is") if portable else ("thresholds", "are beside")
            found += f"; the {learned} learned so far {where} {saved}"
            if not line.one_run:
                flag = f"{line.spellings('resume')[-1]} {saved}"
                remedy += f" To continue from the learned model, add --stage finetune and {flag}."
        return stated(self.host.script.name, found, "a run that reaches its end", remedy)

    def summary(self, seconds: float) -> RunSummary:
        """The summary, after all stages have ended."""
        settings: dict[str, Any] = {"settings": self.settings.as_dict()}
        learned = vars(self.learned) if self.learned else {"adapter": self.adapter.name}
        photographs, drawing, not_compared = self._comparison()
        return RunSummary(
            **learned | settings,
            device=self.device,
            stage=self.options.stage,
            model_before=self.before,
            model_after=self.after,
            train_seconds=seconds,
            curves=self.curves,
            output=self.around or self.output,
            photographs=photographs,
            drawing=drawing,
            not_compared=not_compared,
            already_finished=self.already_finished,
        )

    def _comparison(self) -> tuple[Photographs | None, dict[str, Any], NotComparedError | None]:
        """(photographs, drawing, None) to measure the models, or (None, {}, the reason)."""
        if not (self.learned or self.already_finished):
            return None, {}, None
        try:
            drawing = self.adapter.drawing(self.repo, self.host.arguments)
            joint = self.options.stage == "joint"  # the model of before is another training's
            if not self.after or not (self.before or joint):
                found = f"no model from {'before' if self.after else 'after'} the learning"
                expected = "a model that the host saved"
                remedy = "Have the host save its model before and after."
                raise NotComparedError(f"--stage {self.options.stage}", found, expected, remedy)
            return self.adapter.photographs(self.repo, self.host.arguments), drawing, None
        except NotComparedError as error:
            return None, {}, error

    def _learn_within(self, from_iter: int, *, joint: bool = False) -> None:
        """Run the command once; after ``from_iter`` it learns, in stage 2 or ``joint``."""
        total, file = self.host.iterations, self.host.flags.resume
        if file:
            self.adapter.expect_resumable(Path(file))
        resumed = starting.resumed_at(self.host.line, Path(file)) if file else 0
        start, end = max(resumed, from_iter), total - self.host.line.skipped
        if start >= end:
            at_end = self.options.from_iter is None and start > resumed
            where = "densification ends" if at_end else "learning begins"
            flag = f"Raise {self.host.line.spellings('iterations')[-1]}"
            found = f"iterations {resumed + 1} to {total}" if resumed < total else "no iterations"
            expected = f"iterations after {start}, where {where}"
            remedy = f"{flag}, or lower --from-iter." if start > resumed else f"{flag}."
            raise UsageError(f"--stage {self.options.stage}", found, expected, remedy)
        settings = self.settings = replace(self.options.settings, iterations=end - start)
        origin = Path(file) if file and start == resumed else None
        options: dict[str, Any] = {"from_step": start - resumed, "origin": origin}
        if joint:
            log.info("thresholds learn in iterations %d to %d", start + 1, total)
            settings = replace(settings, iterations=end - resumed)
            schedule = JointSchedule(settings, start - resumed + 1)
            options = {"freeze": False, "schedule": schedule}
        arguments, began = self.host.saving(self.scratch, total, **self._apart()), time.time() - 0.1
        self._learn(total, arguments, start=resumed, settings=settings, **options)
        if not joint:
            self.before = self._model(start, 0.0 if origin else began, origin)

    def _model(self, iteration: int, since: float = 0.0, at: Path | None = None) -> Path | None:
        """The host's PLY of an iteration, at or beside ``at`` or in the output folder."""
        folder = at.parent if at else self.output
        path = self.adapter.model_file(folder, iteration) if folder else None
        path = at if at and at.suffix == ".ply" else path
        return path if path and path.exists() and path.stat().st_mtime >= since else None
