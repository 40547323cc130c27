"""Runs a host's script in this process as ``__main__``, with a session around it.

A training run has two halves. Stage 1 is the host's own training, untouched but for being asked to
write its checkpoint at the end. Stage 2 is the host's own script again, resumed from that
checkpoint for more iterations, with thresholds.
"""

from __future__ import annotations

import argparse
import contextlib
import gc
import json
import logging
import runpy
import sys
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Literal, NoReturn

from fragprune_plugins.adapter import CommandLine, HostAdapter
from fragprune_plugins.detect import HostRepo, locate
from fragprune_plugins.errors import FragpruneError, Interrupted, UsageError
from fragprune_plugins.plugins import load_plugins
from fragprune_plugins.schedule import JointSchedule, Schedule, Settings

log = logging.getLogger("fragprune")

Stage = Literal["auto", "finetune", "joint", "off"]


class HostFailed(FragpruneError):  # noqa: N818 - the host's failure, reported
    """The host's script ended with a non-zero exit code."""

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
        engine: "auto", "reference", "cpu".
        device: "auto" or "cpu" to run a CUDA-only host on the CPU; "cuda" insists on a GPU.
    """

    adapter: str | None = None
    stage: Stage = "auto"
    settings: Settings = field(default_factory=Settings)
    from_iter: int | None = None
    alternate: int | None = None
    engine: str = "auto"
    device: Literal["auto", "cpu", "cuda"] = "auto"


@dataclass(frozen=True)
class RunSummary:
    """What a run did.

    Attributes:
        adapter: its name.
        engine: that drew stage 2, "" when there was none.
        device: "cpu" or "cuda".
        stage: what was asked for.
        iterations: learned in stage 2.
        gaussians: of the trained model.
        fragments_before: per pixel over training views, untruncated.
        fragments_after: per pixel over training views, at each view's last visit.
        model_before: the host's PLY of stage 1, when there is one.
        model_after: the host's PLY after stage 2; its sidecar lies beside it.
        train_seconds: wall time of both stages.
        target_reached: whether a target speed-up was met within 5% on training views; None
            without a target.
        curves: a dict per learned step: step, loss, fragments_per_pixel, pressure,
            threshold_median.
        settings: of the fine-tuning.
        drawing: fields of ``RasterInputs`` by which the host draws its model; None where its
            command leaves no view out, or our readers do not draw what the host does.
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
    drawing: dict[str, Any] | None = None


@dataclass(frozen=True)
class _Invocation:
    """The host's command, taken apart."""

    script: Path
    arguments: list[str]
    flags: argparse.Namespace
    line: CommandLine

    def with_flags(self, **extra: Any) -> list[str]:
        """Arguments with flags appended; argparse lets the last one win."""
        out = list(self.arguments)
        for flag, value in extra.items():
            values = value if isinstance(value, list) else [value]
            out += [getattr(self.line, flag), *map(str, values)]
        return out


def run(command: list[str], options: RunOptions | None = None) -> RunSummary:
    """Run a host's command with fragment pruning.

    Args:
        command: as typed, ``["python", "train.py", "-s", "scene", ...]``; a leading python may be
            left out.
        options: how.

    Raises:
        UsageError: the command names no script.
        UnknownHostError: no adapter fits the script's folder.
        HostFailed: the host ended with an error code.
        Interrupted: Ctrl-C in stage 2; what was learned has been saved.
    """
    import time

    options = options or RunOptions()
    script, arguments = _split(command)
    plugins = load_plugins()
    for finding in plugins.findings:
        if finding.level != "info":
            log.warning("%s", finding)
    tie = plugins.manager.hook.fragprune_select_adapter
    repo, adapter = locate(script.parent, plugins.adapters, options.adapter, select=tie)
    host = _parse(script, arguments, adapter.command_line(repo))
    device = _device(options.device)
    runner = _Runner(host, repo, adapter, plugins, options, device)
    started = time.perf_counter()
    if script.name not in host.line.scripts or options.stage == "off":
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
        adapter: HostAdapter,
        plugins: Any,
        options: RunOptions,
        device: str,
    ) -> None:
        self.host, self.repo, self.adapter, self.plugins = host, repo, adapter, plugins
        self.options, self.device = options, device
        self.output = Path(host.flags.output) if host.flags.output else None
        self.trained: int | None = None  # iterations of stage 1, once it is over
        self.before: Path | None = None
        self.after: Path | None = None
        self.learned: Any = None
        self.curves: list[dict[str, float]] = []

    def observe(self) -> None:
        """The command as it is; thresholds of sidecars are applied."""
        self._execute(self.host.arguments, learn=False)

    def joint(self) -> None:
        """Thresholds learn beside everything else."""
        total = self._iterations()
        start = self.options.from_iter if self.options.from_iter is not None else total // 2
        settings = _with_iterations(self.options.settings, total)
        schedule = JointSchedule(settings, start, self.options.alternate)
        resumed = self.host.flags.resume
        self._execute(
            self.host.arguments,
            learn=True,
            freeze=False,
            start=_iteration_of(Path(resumed)) if resumed else 0,
            schedule=schedule,
            settings=settings,
        )
        self._note_after(total)

    def train_then_finetune(self) -> None:
        """Stage 1 with a checkpoint at its end, then stage 2 from there."""
        if self.host.flags.resume and self.host.script.name not in self.host.line.continues:
            return self.finetune()
        total = self._iterations()
        checkpoints = sorted({*(self.host.flags.save_checkpoints or []), total})
        log.info("stage 1: the host's own training, %d iterations", total)
        self._execute(self.host.with_flags(save_checkpoints=checkpoints), learn=False)
        saved = self.adapter.saved_iterations(self.output) if self.output else []
        if total not in (iteration for iteration, _ in saved):  # hosts refuse with exit code 0 too
            raise HostFailed(
                self.host.script.name,
                f"ended without a checkpoint of iteration {total}",
                "its own training to come to its end",
                "Read the host's own message above.",
            )
        self.trained = total
        self.finetune()

    def finetune(self) -> None:
        """Stage 2: resume, or wait for ``from_iter`` inside one run."""
        settings = self.options.settings
        if self.options.from_iter is not None:
            start, total = self.options.from_iter, self._iterations()
            settings = _with_iterations(settings, max(1, total - start))
            self._execute(self.host.arguments, learn=True, from_step=start, settings=settings)
            self._note_after(total)
            return
        resumed = self.adapter.resumed_by(self.host.script, self.host.arguments)
        self.host = _parse(*resumed, self.host.line)
        with self._checkpoint() as (iteration, checkpoint):
            self._note_before(iteration)
            total = iteration + settings.iterations
            log.info("stage 2: %d iterations from %s", settings.iterations, checkpoint)
            arguments = self.host.with_flags(iterations=total, resume=checkpoint)
            if self.output is not None and not self.host.flags.output:
                arguments += [self.host.line.output[-1], str(self.output)]  # the host named it
            self._execute(arguments, learn=True, start=iteration)
            self._note_after(total)

    @contextlib.contextmanager
    def _checkpoint(self) -> Iterator[tuple[int, Path]]:
        """The checkpoint to resume from; one made from a PLY is removed afterwards."""
        if self.host.flags.resume and self.trained is None:
            path = Path(self.host.flags.resume)
            yield _iteration_of(path), path
            return
        saved = self.adapter.saved_iterations(self.output) if self.output else []
        if self.trained is not None:  # the folder may hold later ones of another run
            saved = [each for each in saved if each[0] == self.trained]
        if not saved:
            raise UsageError(
                "--stage finetune",
                f"nothing to start from in {self.output or 'no output folder'}",
                f"{self.host.line.resume} FILE, or {self.host.line.output[-1]} DIR of a finished "
                "training",
                "Name one of them in the host's command.",
            )
        iteration, path = saved[-1]
        if path.suffix != ".ply":
            yield iteration, path
            return
        made = path.with_name(f".fragprune_{iteration}.pth")
        self.adapter.checkpoint_from_ply(path, iteration, made)
        try:
            yield iteration, made
        finally:
            made.unlink(missing_ok=True)

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
        from fragprune_plugins.session import Session

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
        )
        known = set(sys.modules)
        try:
            with session, _host_process(self.host.script, arguments, self.device):
                try:
                    runpy.run_path(str(self.host.script), run_name="__main__")
                except KeyboardInterrupt as error:  # here, where saving still writes the sidecar
                    saved = session.save_interrupted() if learn else None
                    raise Interrupted(
                        self.host.script.name,
                        "Ctrl-C" + (f"; thresholds so far are beside {saved}" if saved else ""),
                        "the run to end",
                        "Resume with fragprune run --stage finetune."
                        if saved
                        else "Start it again.",
                    ) from error
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
            _forget_modules(self.repo.root, known)
            if learn:
                self.learned = session.finish()
                self.curves = session.curves

    def summary(self, seconds: float) -> RunSummary:
        """Everything the command line prints."""
        learned = self.learned
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
            drawing=self.adapter.drawing(self.repo, self.host.arguments),
        )

    def _iterations(self) -> int:
        return self.host.flags.iterations or self.host.line.default_iterations

    def _note_before(self, iteration: int) -> None:
        path = self.adapter.model_file(self.output, iteration) if self.output else None
        self.before = path if path and path.exists() else None

    def _note_after(self, iteration: int) -> None:
        path = self.adapter.model_file(self.output, iteration) if self.output else None
        self.after = path if path and path.exists() else None


def _split(command: list[str]) -> tuple[Path, list[str]]:
    """Script and its arguments; a leading interpreter is dropped."""
    words = list(command)
    if words and Path(words[0]).name.startswith("python"):
        words = words[1:]
    if not words or not words[0].endswith(".py"):
        raise UsageError(
            "command",
            repr(" ".join(command)) if command else "none",
            "-- python train.py ... (a script of the host)",
            "Put the host's own training command after --.",
        )
    script = Path(words[0]).resolve()
    if not script.is_file():
        raise UsageError(
            str(script), "no such file", "the host's training script", "Check the path."
        )
    return script, words[1:]


class _Flags(argparse.ArgumentParser):
    """Says what is wrong with a flag as we say everything."""

    def error(self, message: str) -> NoReturn:
        raise UsageError(
            "the host's command", message, "flags the host understands", "Correct the command."
        )


def _parse(script: Path, arguments: list[str], line: CommandLine) -> _Invocation:
    """Read the few flags we need; the host parses them all itself."""
    parser = _Flags(add_help=False)
    parser.add_argument(line.iterations, dest="iterations", type=int)
    parser.add_argument(*line.output, dest="output")
    parser.add_argument(*line.source, dest="source")
    parser.add_argument(line.save_checkpoints, dest="save_checkpoints", type=int, nargs="*")
    parser.add_argument(line.resume, dest="resume")
    if line.config:
        parser.add_argument(line.config, dest="config")
    flags, _ = parser.parse_known_args(arguments)
    if line.config and flags.config:
        _refuse_overrides(Path(flags.config), line)
    return _Invocation(script, arguments, flags, line)


def _refuse_overrides(config: Path, line: CommandLine) -> None:
    """A configuration file wins over the command line: it must leave alone what we put there."""
    ours = (*line.output, line.iterations, line.save_checkpoints, line.resume)
    try:
        values = json.loads(config.read_text())
    except (OSError, ValueError) as error:
        raise UsageError(
            f"{line.config} {config}", str(error), "a readable JSON file", "Correct the command."
        ) from error
    if taken := sorted({flag.lstrip("-") for flag in ours} & set(values)):
        raise UsageError(
            f"{line.config} {config}",
            f"sets {', '.join(taken)}, over whatever the command says",
            "these on the command line, where stage 2 can change them",
            "Move them there.",
        )


def _device(wanted: str) -> str:
    import torch

    if wanted == "cpu":
        return "cpu"
    if torch.cuda.is_available():
        return "cuda"
    if wanted == "cuda":
        raise UsageError(
            "--device cuda", "no CUDA device", "one", "Use --device cpu for small scenes."
        )
    return "cpu"


def _with_iterations(settings: Settings, iterations: int) -> Settings:
    from dataclasses import replace

    return replace(settings, iterations=iterations)


def _iteration_of(checkpoint: Path) -> int:
    """The iteration a checkpoint was written at: hosts save (capture, iteration)."""
    import torch

    if not checkpoint.is_file():
        raise UsageError(str(checkpoint), "no such file", "a checkpoint", "Check the path.")
    with _host_checkpoints():
        content = torch.load(checkpoint, map_location="cpu")
    return int(content[-1])


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
def _host_process(script: Path, arguments: list[str], device: str) -> Iterator[None]:
    """What a fresh interpreter would give the script, put back afterwards."""
    from fragprune_plugins.device import cpu_only

    saved = sys.argv, sys.path[:], sys.stdout, sys.stderr
    sys.argv = [str(script), *arguments]
    sys.path.insert(0, str(script.parent))
    try:
        with contextlib.ExitStack() as stack:
            stack.enter_context(_host_checkpoints())
            if device == "cpu":
                stack.enter_context(cpu_only())
            yield
    finally:
        sys.argv, sys.path[:], sys.stdout, sys.stderr = saved


def _forget_modules(root: Path, known: set[str]) -> None:
    """Drop the host's own modules, so that its script runs again as if for the first time."""
    for name in sys.modules.keys() - known:
        file = getattr(sys.modules[name], "__file__", None)
        if file and Path(file).is_relative_to(root) and "site-packages" not in file:
            del sys.modules[name]
    gc.collect()  # closes what module globals held, the viewer's socket among them
