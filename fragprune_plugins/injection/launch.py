"""Runs a host's script in this process as ``__main__``, with a session around it.

A training run has two halves. Stage 1 is the host's own training, untouched but for being asked to
write its checkpoint at the end. Stage 2 is the host's own script again, resumed from that
checkpoint for more iterations, with thresholds.
"""

from __future__ import annotations

import argparse
import contextlib
import gc
import logging
import runpy
import sys
import tempfile
import traceback
from collections.abc import Iterator
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from pickle import UnpicklingError
from typing import Any, Literal
from unittest import mock

from fragprune_plugins.datasets.photographs import Photographs
from fragprune_plugins.errors import (
    FragpruneError,
    Interrupted,
    ModelFileError,
    NotComparedError,
    Terminated,
    UsageError,
)
from fragprune_plugins.hosts import preflight
from fragprune_plugins.hosts.adapter import (
    CHECKPOINT_KEY,
    CommandLine,
    ConfigFile,
    ScriptAdapter,
    read_config,
)
from fragprune_plugins.hosts.choosing import choose, locate
from fragprune_plugins.hosts.source import HostRepo
from fragprune_plugins.learning.interruption import Terminate, sigterm_interrupts
from fragprune_plugins.learning.schedule import JointSchedule, Schedule, Settings
from fragprune_plugins.plugins.loading import installed
from fragprune_plugins.storage import records

log = logging.getLogger("fragprune")

_OURS = Path(__file__).parents[1]

Stage = Literal["auto", "finetune", "joint", "off"]


class HostFailed(FragpruneError):  # noqa: N818 - the host's failure, reported
    """The host's script raised, or ended with a non-zero exit code."""

    code = "host-failed"


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


@dataclass(frozen=True)
class _Invocation:
    """The host's command, taken apart; ``module`` where it was ``python -m module``."""

    script: Path
    arguments: list[str]
    flags: argparse.Namespace
    line: CommandLine
    module: str = ""

    def with_flags(self, scratch: Path, **extra: Any) -> list[str]:
        """Arguments with flags appended; argparse lets the last one win.

        Args:
            scratch: folder for a copy of the host's configuration file, which wins over flags.
            extra: values by fields of the command line.
        """
        given = {self.line.spellings(name)[-1]: value for name, value in extra.items()}
        out = list(self.arguments)
        if self.line.config and self.flags.config:
            copy = scratch / self.flags.config.name
            overrule(self.line.config, self.flags.config, copy, given)
            return [*out, self.line.config.flag, str(copy)]
        for flag, value in given.items():
            values = value if isinstance(value, list) else [value]
            out += [flag, *map(str, values)]
        return out


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
    import time

    from fragprune_plugins.plugins.hooks import engine_for, select_adapter

    options = options or RunOptions()
    script, arguments, module = _split(command)
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
    host = _parse(script, arguments, adapter.command_line(repo), module)
    device = _device(options.device, options.engine)
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
        host: _Invocation,
        repo: HostRepo,
        adapter: ScriptAdapter,
        plugins: Any,
        options: RunOptions,
        device: str,
        scratch: Path,
    ) -> None:
        self.host, self.repo, self.adapter, self.plugins = host, repo, adapter, plugins
        self.options, self.device, self.scratch = options, device, scratch
        self.output = Path(host.flags.output) if host.flags.output else None
        self.around: Path | None = None  # of stage 1, where stage 2 has a folder of its own
        self.trained: tuple[int, Path] | None = None  # stage 1's end, once it is over
        self.before: Path | None = None
        self.after: Path | None = None
        self.learned: Any = None
        self.curves: list[dict[str, float]] = []

    def observe(self) -> None:
        """The command as it is; thresholds of sidecars are applied."""
        self._execute(self.host.arguments, learn=False)

    def joint(self) -> None:
        """Thresholds learn beside everything else."""
        resumed, start, total = self._learning(self.options.from_iter)
        steps = total - resumed - self.host.line.skipped
        settings = _with_iterations(self.options.settings, steps)
        schedule = JointSchedule(settings, max(1, start - resumed), self.options.alternate)
        self._execute(
            self._saving(total),
            learn=True,
            freeze=False,
            start=resumed,
            schedule=schedule,
            settings=settings,
        )
        self._note_after(total)

    def train_then_finetune(self) -> None:
        """Stage 1 with a checkpoint at its end, then stage 2 from there."""
        if self.host.flags.resume and self.host.script.name not in self.host.line.continues:
            return self.finetune()
        self.adapter.resumed_by(self.host.script, self.host.arguments)  # refuse before stage 1
        total = self._iterations()
        log.info("stage 1: the host's own training, %d iterations", total)
        arguments = self.host.with_flags(self.scratch, save_checkpoints=self._checkpoints(total))
        earlier = {path: path.stat().st_mtime_ns for _, path in self._saved()}
        self._execute(arguments, learn=False)
        ends = [
            (path.suffix != ".ply", path)
            for iteration, path in self._saved()
            if iteration == total and earlier.get(path) != path.stat().st_mtime_ns
        ]
        if not ends:  # hosts refuse with exit code 0 too
            raise HostFailed(
                self.host.script.name,
                f"ended without a checkpoint of iteration {total}",
                "its own training to come to its end",
                "Read the host's own message above.",
            )
        self.trained = total, max(ends)[1]
        self.finetune()

    def finetune(self) -> None:
        """Stage 2: resume, or wait for ``from_iter`` inside one run."""
        settings = self.options.settings
        if self.options.from_iter is not None:
            resumed, after, total = self._learning(self.options.from_iter)
            settings = _with_iterations(settings, total - after - self.host.line.skipped)
            passed = after - resumed
            self._execute(
                self._saving(total), learn=True, from_step=passed, start=resumed, settings=settings
            )
            self._note_after(total)
            return
        again = self.adapter.resumed_by(self.host.script, self.host.arguments)
        module = _beside(self.host.module, again[0]) if self.host.module else ""
        self.host = _parse(*again, self.host.line, module)
        if self.output is None and self.host.flags.output:
            self.output = Path(self.host.flags.output)
        with self._checkpoint() as (iteration, checkpoint):
            self._note_before(iteration)
            start = 0 if self.host.line.restarts else iteration
            total = start + settings.iterations + self.host.line.skipped
            extra = {"iterations": total, "resume": str(checkpoint)}
            own = "finetuned" if self.host.line.restarts else ""
            own = own if settings.truncate else "control"  # what was learned stays where it is
            if own and self.output is not None:
                self.around, self.output = self.output, self.output / own
            if self.output is not None and str(self.output) != self.host.flags.output:
                extra["output"] = str(self.output)
            self._execute(self._saving(total, **extra), learn=True, start=start)
            self._note_after(total)

    @contextlib.contextmanager
    def _checkpoint(self) -> Iterator[tuple[int, Path]]:
        """The checkpoint to resume from; one made from a PLY is removed afterwards."""
        iteration, path, why = self._start()
        steps = self.options.settings.iterations
        log.info("stage 2: %d iterations from iteration %d, %s: %s", steps, iteration, path, why)
        if path.suffix != ".ply" or self.host.line.restarts:
            yield iteration, path
            return
        made = path.with_name(f".fragprune_{iteration}.pth")
        self.adapter.checkpoint_from_ply(path, iteration, made)
        try:
            yield iteration, made
        finally:
            made.unlink(missing_ok=True)

    def _start(self) -> tuple[int, Path, str]:
        """What stage 2 starts from, and why: iteration, file, reason."""
        if self.trained is not None:
            return *self.trained, "the end of stage 1"
        if self.host.flags.resume:
            path = Path(self.host.flags.resume)
            ply = path.suffix == ".ply" and not self.host.line.restarts
            at = _iteration_of_ply(path) if ply else self._iteration_of(path)
            return at, path, "the command names it"
        where, flag = self.output or "no output folder", self.host.line.spellings("resume")[-1]
        saved, newer = self._saved(), 0
        while saved and self._learned(saved[-1][1]):
            saved.pop()
            newer += 1
        if not saved and newer:
            raise UsageError(
                "--stage finetune",
                f"nothing in {where} but what was learned here, or a control",
                "what training alone wrote",
                f"To go on from one of these files, name it with {flag}.",
            )
        if not saved:
            raise UsageError(
                "--stage finetune",
                f"nothing to start from in {where}",
                f"{flag} FILE, or {self.host.line.output[-1]} DIR of a finished training",
                "Name one of them in the host's command.",
            )
        iteration, path = saved[-1]
        later = [(at, file) for at, file in saved if at > iteration and not self._learned(file)]
        if later:
            log.warning(
                "%s is of a later iteration, but older than what stage 2 starts from; "
                "if you meant it, name it with %s",
                max(reversed(later), key=lambda each: each[0])[1],
                flag,
            )
        passed = f"; {newer} newer of stage 2 passed over" if newer else ""
        return iteration, path, f"what training alone wrote last{passed}"

    def _saved(self) -> list[tuple[int, Path]]:
        return self.adapter.saved_iterations(self.output) if self.output else []

    def _learned(self, path: Path) -> bool:
        """Whether a file was written while thresholds learned, or by a control: not by stage 1."""
        from fragprune_plugins.storage import sidecar

        record = records.beside(path)  # version 0.1 marked its controls by nothing else
        if record is not None and record.command == "run":
            return True
        if path.suffix == ".ply":
            return sidecar.belongs(path)
        return CHECKPOINT_KEY in self.adapter.checkpoint_state(_read_checkpoint(path)[0])

    def _execute(
        self,
        arguments: list[str],
        *,
        learn: bool,
        freeze: bool = True,
        from_step: int = 0,
        start: int = 0,
        schedule: Schedule | None = None,
        settings: Settings | None = None,
    ) -> None:
        from fragprune_plugins.injection.session import Session

        session = Session(
            self.adapter,
            self.repo,
            self.plugins,
            settings or self.options.settings,
            learn=learn,
            freeze=freeze,
            from_step=from_step,
            start=start,
            schedule=schedule,
            engine=self.options.engine,
            drop_in=True if self.device == "cpu" else None,
            output=self.output,
            origin=self.around,
        )
        known = set(sys.modules)
        try:
            folder = Path.cwd() if self.host.module else self.host.script.parent
            with contextlib.ExitStack() as stack:
                stack.enter_context(_telling(self.host.script, self.repo.root))
                stack.enter_context(session)
                process = _host_process(self.host.script, arguments, self.device, folder)
                stack.enter_context(process)
                if learn:
                    stack.enter_context(sigterm_interrupts())
                try:
                    if self.host.module:
                        runpy.run_module(self.host.module, run_name="__main__", alter_sys=True)
                    else:
                        runpy.run_path(str(self.host.script), run_name="__main__")
                except KeyboardInterrupt as error:  # here, where saving still writes the sidecar
                    saved = session.save_interrupted() if learn else None
                    raise self._interrupted(error, saved) from error
            session.expect_drawn()
        except SystemExit as error:
            if error.code not in (None, 0):
                raise HostFailed(
                    self.host.script.name,
                    f"ended with exit code {error.code}",
                    "0",
                    "Read the host's own message above.",
                ) from error
        finally:
            self.output = session.output or self.output
            _forget_modules(self.repo.root, known, self.adapter.installed)
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

    def _iteration_of(self, resumed: Path) -> int:
        """The iteration that a run from this file goes on after."""
        return 0 if self.host.line.restarts else _iteration_of(resumed)

    def _learning(self, from_iter: int | None) -> tuple[int, int, int]:
        """Iterations of the host: the one this run goes on after, where learning begins, the last.

        Args:
            from_iter: as asked for; half of the training where it is not.

        Raises:
            UsageError: nothing would be learned.
        """
        total, file = self._iterations(), self.host.flags.resume
        resumed = self._iteration_of(Path(file)) if file else 0
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

    def _checkpoints(self, total: int) -> list[int]:
        """Iterations to write a checkpoint at: the command's, and the last."""
        return sorted({*(self.host.flags.save_checkpoints or []), total})

    def _saving(self, total: int, **extra: Any) -> list[str]:
        """The host's arguments with more flags, and told to save its model in the end."""
        if self.host.line.checkpoints_only:
            extra["save_checkpoints"] = self._checkpoints(total)
        return self.host.with_flags(self.scratch, **extra) if extra else self.host.arguments

    def _iterations(self) -> int:
        return self.host.flags.iterations or self.host.line.default_iterations

    def _note_before(self, iteration: int) -> None:
        path = self.adapter.model_file(self.output, iteration) if self.output else None
        self.before = path if path and path.exists() else None

    def _note_after(self, iteration: int) -> None:
        path = self.adapter.model_file(self.output, iteration) if self.output else None
        self.after = path if path and path.exists() else None


def _split(command: list[str]) -> tuple[Path, list[str], str]:
    """Script, its arguments, and the module where it is one; a leading interpreter is dropped."""
    words = list(command)
    if words and Path(words[0]).name.startswith("python"):
        words = words[1:]
    if words[:1] == ["-m"] and len(words) > 1:
        return _script_of(words[1]), words[2:], words[1]
    if not words or not words[0].endswith(".py"):
        raise UsageError(
            "command",
            repr(" ".join(command)) if command else "none",
            "-- python train.py ... (a script of the host), or -- python -m package.module ...",
            "Put the host's own training command after --.",
        )
    script = Path(words[0]).resolve()
    if not script.is_file():
        raise UsageError(
            str(script), "no such file", "the host's training script", "Check the path."
        )
    return script, words[1:], ""


def _script_of(module: str) -> Path:
    """The file that ``python -m`` runs, found without importing: here, else an installed one."""
    for repo in (HostRepo(Path.cwd()), HostRepo.installed(module.split(".")[0])):
        script = repo.path(module) if repo else None
        if script is not None and script.name == "__init__.py":
            script = repo.path(f"{module}.__main__") if repo else None
        if script is not None:
            return script
    raise UsageError(
        f"python -m {module}",
        "no such module",
        "one in this folder, or of an installed package",
        "Go to the host's folder, install the package, or check the name.",
    )


def _beside(module: str, script: Path) -> str:
    """The name of a script of the same folder as a module's."""
    return ".".join([*module.split(".")[:-1], script.stem])


def _parse(script: Path, arguments: list[str], line: CommandLine, module: str = "") -> _Invocation:
    """Read the few flags we need; the host parses them all itself."""
    return _Invocation(script, arguments, line.read(arguments), line, module)


def overrule(config: ConfigFile, path: Path, copy: Path, given: dict[str, Any]) -> None:
    """Write a copy of a configuration file with other values, and see that it says so."""
    values = {flag.lstrip("-"): value for flag, value in given.items()}
    copy.write_text(config.overrule(path.read_text(encoding="utf-8"), values), encoding="utf-8")
    said = read_config(config, copy)
    if ignored := sorted(name for name in values if said.get(name) != values[name]):
        raise UsageError(
            f"{config.flag} {path}",
            f"a layout that {', '.join(ignored)} cannot be added to",
            "that of the host's own examples",
            "Write it like these.",
        )


def _device(wanted: str, engine: str) -> str:
    """Where the host runs: it was written for a GPU, so "auto" gives it any that there is."""
    import torch

    from fragprune_plugins.engines import device_for

    if wanted == "auto" and torch.cuda.is_available():
        return "cuda"
    return str(device_for(wanted, engine))


def _with_iterations(settings: Settings, iterations: int) -> Settings:
    from dataclasses import replace

    return replace(settings, iterations=iterations)


def _iteration_of(checkpoint: Path) -> int:
    """The iteration a checkpoint was written at."""
    return _read_checkpoint(checkpoint)[1]


def _iteration_of_ply(ply: Path) -> int:
    """By its folder, as hosts save: ``iteration_N/point_cloud.ply``."""
    number = ply.parent.name.removeprefix("iteration_")
    if ply.is_file() and number.isdigit():
        return int(number)
    raise UsageError(
        str(ply),
        "a PLY outside iteration_N" if ply.is_file() else "no such file",
        "a checkpoint, or point_cloud/iteration_N/point_cloud.ply",
        "Check the path.",
    )


def _read_checkpoint(path: Path) -> tuple[Any, int]:
    """What a checkpoint holds, its tensors still on disk: hosts save (capture, iteration).

    Raises:
        UsageError: there is none.
        ModelFileError: it cannot be read.
    """
    import torch

    if not path.is_file():
        raise UsageError(str(path), "no such file", "a checkpoint", "Check the path.")
    try:
        with _host_checkpoints():
            capture, iteration = torch.load(path, map_location="cpu", weights_only=True, mmap=True)
            return capture, int(iteration)
    except (UnpicklingError, RuntimeError, OSError, EOFError, ValueError, TypeError) as error:
        raise ModelFileError(
            str(path),
            f"not readable as a checkpoint ({str(error).splitlines()[0]})",
            "(capture, iteration), as hosts save it",
            "It was cut off, or is no checkpoint: remove it, or name another.",
        ) from error


@contextlib.contextmanager
def _host_checkpoints() -> Iterator[None]:
    """Let torch's safe loader read the hosts' checkpoints: they hold NumPy scalars, no more."""
    import numpy as np
    import torch

    scalar: Any = np.float64(0).__reduce__()[0]
    kinds: list[Any] = [type(np.dtype(kind)) for kind in ("f4", "f8", "i4", "i8")]
    with torch.serialization.safe_globals([scalar, np.dtype, *kinds]):
        yield


@contextlib.contextmanager
def _host_pictures() -> Iterator[None]:
    """Let Pillow take signed bytes, as hosts that read Blender scenes give it; it used to."""
    import numpy as np
    from PIL import Image

    fromarray = Image.fromarray

    def from_bytes(array: Any, mode: str | None = None) -> Any:
        signed = isinstance(array, np.ndarray) and array.dtype == np.int8
        return fromarray(array.view(np.uint8) if signed else array, mode)

    with mock.patch.object(Image, "fromarray", from_bytes):
        yield


@contextlib.contextmanager
def current_gpu(device: str) -> Iterator[None]:
    """Where a GPU is named by its number, inside it is "cuda", whichever a host would choose."""
    import torch

    if not device.startswith("cuda:"):
        yield
        return
    with torch.cuda.device(device), mock.patch.object(torch.cuda, "set_device"):
        yield


@contextlib.contextmanager
def _telling(script: Path, root: Path) -> Iterator[None]:
    """What a host raises is told in a line; the whole traceback goes to stderr, for who needs it.

    Args:
        script: that runs.
        root: of the host.
    """
    try:
        yield
    except FragpruneError:
        raise
    except Exception as error:
        traceback.print_exc()
        frames = traceback.extract_tb(error.__traceback__)
        inside = [frame for frame in frames if Path(frame.filename).is_relative_to(root)]
        where = script.name
        if inside:
            file = Path(inside[-1].filename).relative_to(root)
            where = f"{file}:{inside[-1].lineno} in {inside[-1].name}"
        message = "".join(str(error).strip().splitlines()[:1])
        remedy = "Read the traceback above."
        lacking = (error.name or "").split(".")[0] if isinstance(error, ImportError) else ""
        if isinstance(error, ModuleNotFoundError) and not HostRepo(root).path(lacking):
            remedy = f"Run: {preflight.install([preflight.Missing(lacking, where)])}"
        elif Path(frames[-1].filename).is_relative_to(_OURS):
            remedy = "It came up in fragprune: report it with the traceback above."
        raise HostFailed(
            where,
            f"{type(error).__name__}{f': {message}' if message else ''}",
            f"{script.name} to come to its end",
            remedy,
        ) from error


@contextlib.contextmanager
def _host_process(
    script: Path, arguments: list[str], device: str, folder: Path | None = None
) -> Iterator[None]:
    """What a fresh interpreter would give the script, put back afterwards."""
    from fragprune_plugins.injection.cpu_only import cpu_only

    saved = sys.argv, sys.path[:], sys.stdout, sys.stderr
    sys.argv = [str(script), *arguments]
    sys.path.insert(0, str(folder or script.parent))
    try:
        with contextlib.ExitStack() as stack:
            stack.enter_context(_host_checkpoints())
            stack.enter_context(_host_pictures())
            if device == "cpu":
                stack.enter_context(cpu_only())
            else:
                stack.enter_context(current_gpu(device))
            yield
    finally:
        sys.argv, sys.path[:], sys.stdout, sys.stderr = saved


def _forget_modules(root: Path, known: set[str], packages: tuple[str, ...] = ()) -> None:
    """Drop the host's own modules, so that its script runs again as if for the first time.

    Args:
        root: of a checkout, which may hold an environment with packages that are not its own.
        known: names of modules that were there before the host ran.
        packages: that are the host, where it is installed; their compiled modules stay.
    """
    for name in sys.modules.keys() - known:
        file = getattr(sys.modules[name], "__file__", None) or ""
        if name.split(".")[0] in packages:
            own = not file or file.endswith(".py")
        else:
            own = file != "" and Path(file).is_relative_to(root) and "site-packages" not in file
        if own:
            del sys.modules[name]
    gc.collect()  # closes what module globals held, the viewer's socket among them
