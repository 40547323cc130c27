"""Where the steps of learning are written while they happen: CSV, TensorBoard, Weights & Biases.

A kind of log is an entry point: a class that gets the place that ``--log KIND:PLACE`` names.
"""

from __future__ import annotations

import contextlib
import csv
import functools
from collections.abc import Iterator, Sequence
from dataclasses import asdict, fields
from importlib.metadata import EntryPoint
from pathlib import Path
from typing import Any, Protocol

import click
from tqdm import tqdm

from fragprune_plugins.errors import OutputError, UsageError
from fragprune_plugins.errors import log as told
from fragprune_plugins.learning.events import StepStats
from fragprune_plugins.plugins.hookspecs import hookimpl
from fragprune_plugins.plugins.loading import Plugins, installed
from fragprune_plugins.plugins.points import blaming, load, offered
from fragprune_plugins.workbench.commands.options import Function
from fragprune_plugins.workbench.ranks import launched

GROUP = "fragprune.logs"  # the entry-point group of kinds of logs
COLUMNS = tuple(each.name for each in fields(StepStats))


class Log(Protocol):
    """A place for steps."""

    def write(self, stats: StepStats) -> None:
        """Write a step."""

    def close(self) -> None:
        """No further step comes."""


class CsvLog:
    """A row a step. Rows of earlier steps stay: a fine-tuning that was killed goes on after them.

    All others are another run's, or what the kill has lost, and go. A file that cannot be written,
    or that is no log, is an OutputError.
    """

    def __init__(self, path: str) -> None:
        self._path, self._begun = Path(path), False
        try:
            self._before = self._path.read_text("utf-8", "replace") if self._path.is_file() else ""
            if self._before and not self._before.startswith(f"{COLUMNS[0]},"):
                raise OSError("a file that is no log")
            self._file = open(self._path, "a", newline="", encoding="utf-8")  # noqa: SIM115
        except (OSError, ValueError) as error:  # ValueError: a NUL in the name
            why = getattr(error, "strerror", None) or str(error)
            raise OutputError(path, why, "a file for --log", "Choose another place.") from error
        self._rows = csv.writer(self._file)

    def _begin(self, first: int) -> None:
        """Write the heads of the columns, and again the rows that stay."""
        self._begun = True
        rows = [row.split(",") for row in self._before.splitlines()[1:]]
        whole = (row for row in rows if row[0].isdecimal() and len(row) == len(COLUMNS))
        kept = [row for row in whole if int(row[0]) < first]
        if rows:
            said = "%s has rows of an earlier run: %d stay, %d go"
            told.warning(said, self._path, len(kept), len(rows) - len(kept))
        if self._before:
            self._file.truncate(0)
        self._rows.writerows([COLUMNS, *kept])

    def write(self, stats: StepStats) -> None:
        """Append a row."""
        if not self._begun:
            self._begin(stats.step)
        self._rows.writerow(asdict(stats).values())
        self._file.flush()  # whoever follows the file sees the step

    def close(self) -> None:
        """Close the file."""
        self._file.close()


class TensorBoardLog:
    """Scalars under ``fragprune/`` in an event file; UsageError if TensorBoard is not installed."""

    def __init__(self, folder: str) -> None:
        try:
            from torch.utils.tensorboard import SummaryWriter
        except ImportError as error:
            raise _missing("tensorboard") from error
        self._writer = SummaryWriter(folder)

    def write(self, stats: StepStats) -> None:
        """Add a point to every curve."""
        for name, value in _values(stats).items():
            self._writer.add_scalar(name, value, stats.step)

    def close(self) -> None:
        """Write what is pending."""
        self._writer.close()


class WandbLog:
    """A run of Weights & Biases; the network, unless WANDB_MODE=offline. UsageError without it."""

    def __init__(self, project: str) -> None:
        try:
            import wandb
        except ImportError as error:
            raise _missing("wandb") from error
        self._run: Any = wandb.init(project=project)

    def write(self, stats: StepStats) -> None:
        """Log a step."""
        self._run.log(_values(stats), step=stats.step)

    def close(self) -> None:
        """End the run."""
        self._run.finish()


class Bar:
    """A bar on stderr below the host's own, if that is a terminal; ``warmup`` steps come first."""

    def __init__(self, total: int, warmup: int) -> None:
        self._total, self._warmup = total, warmup
        self._bar: Any = None

    def write(self, stats: StepStats) -> None:
        """Go on by a step."""
        if self._bar is None:
            self._bar = tqdm(total=self._total, disable=None, unit="it", position=1)
        name = "warm-up" if stats.step <= self._warmup else "fine-tuning"
        self._bar.set_description(f"fragprune, {name}", refresh=False)
        drawn, loss = f"{stats.fragments_per_pixel:.1f}/px", f"{stats.loss:.4f}"
        self._bar.set_postfix(fragments=drawn, loss=loss, refresh=False)
        self._bar.update()

    def close(self) -> None:
        """Leave the bar as it is."""
        if self._bar is not None:
            self._bar.close()


class _Observer:
    def __init__(self, log: Log) -> None:
        self._log = log

    @hookimpl
    def fragprune_step(self, stats: StepStats) -> None:
        self._log.write(stats)


@contextlib.contextmanager
def logging_steps(logs: Sequence[Log], plugins: Plugins | None = None) -> Iterator[None]:
    """Write the steps that are taken in a block, and close the logs after it."""
    plugins = plugins or installed()
    with contextlib.ExitStack() as stack:
        for number, log in enumerate(logs):
            name = f"log-{number}-{type(log).__name__}"
            stack.callback(_close, log)
            plugins.register(_Observer(log), name)
            stack.callback(plugins.remove, name)
        yield


def _close(log: Log) -> None:
    """Close a log. What was learned is no worse for one that fails at it."""
    try:
        log.close()
    except (Exception, SystemExit) as error:
        kind, why = type(log), f"{type(error).__name__}: {error}"
        told.warning("--log: %s.%s cannot be closed (%s)", kind.__module__, kind.__name__, why)


def _values(stats: StepStats) -> dict[str, float]:
    return {f"fragprune/{name}": value for name, value in asdict(stats).items() if name != "step"}


def _missing(library: str) -> UsageError:
    remedy = f"pip install 'fragprune-plugins[{library}]'"
    return UsageError("--log", f"{library} is not installed", f"the package {library}", remedy)


def _places(
    ctx: click.Context, param: click.Parameter, words: tuple[str, ...]
) -> list[tuple[EntryPoint, str]]:
    """Kind and place of each log."""
    kinds, places = offered(GROUP), []
    for word in words:
        kind, _, place = word.partition(":")
        if kind not in kinds or not place:
            known = ", ".join(f"{kind}:PLACE" for kind in kinds)
            raise click.BadParameter(f"'{word}' is none of {known}.", ctx, param)
        places.append((kinds[kind], place))
    return places


def log_option(function: Function) -> Function:
    """The option ``--log``: the steps that the command takes are written there."""

    @click.option(
        "--log",
        "logs",
        metavar="KIND:PLACE",
        callback=_places,
        multiple=True,
        help="Write every step's loss, fragments, pressure and cutoff to csv:FILE, "
        "tensorboard:FOLDER or wandb:PROJECT, or as a plugin does. May be given several times.",
    )
    @functools.wraps(function)
    def logged(*args: Any, logs: list[tuple[EntryPoint, str]], **kwargs: Any) -> Any:
        if not logs or not launched().first:
            return function(*args, **kwargs)
        with logging_steps([blaming(kind)(load(kind, type))(place) for kind, place in logs]):
            return function(*args, **kwargs)

    return logged  # type: ignore[return-value]
