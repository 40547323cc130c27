"""Shared by all commands: --json, errors, exit codes, and the options of scenes and engines."""

from __future__ import annotations

import contextlib
import functools
import json
import math
import os
import re
import sys
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypeVar

import click
from click.core import ParameterSource

from fragprune_plugins.errors import (
    FragpruneError,
    Interrupted,
    MemoryLimitError,
    ModelFileError,
    OutputError,
    PathError,
    Terminated,
    UsageError,
    printable,
)
from fragprune_plugins.files.records import strict
from fragprune_plugins.learning.interruption import EXIT_CODE, Terminate
from fragprune_plugins.workbench.ranks import launched, local_rank, speaks

if TYPE_CHECKING:
    import torch

    from fragprune_plugins.engines import Engine
    from fragprune_plugins.hosts.photographs import Photographs
    from fragprune_plugins.workbench.scenes.dataset import Shot

Function = TypeVar("Function", bound=Callable[..., Any])

FILE = click.Path(path_type=Path)


class OutFile(click.Path):
    """Type of an option for a file to write; refuses a name without a suffix before any work.

    Args:
        suffixes: one is required, such as ".ply"; upper and lower case are equal.
    """

    def __init__(self, *suffixes: str) -> None:
        super().__init__(path_type=Path)
        self.suffixes = suffixes

    def convert(self, value: Any, param: click.Parameter | None, ctx: click.Context | None) -> Path:
        """The option's value as a path; a usage error if it lacks the suffix."""
        path: Path = super().convert(value, param, ctx)  # type: ignore[assignment]
        if path.suffix.lower() not in self.suffixes:
            self.fail(f"'{path}' does not end with {' or '.join(self.suffixes)}.", param, ctx)
        return path


class Number(click.FloatRange):
    """Type of an option for a number; refuses NaN, which passes every range, and infinity."""

    def convert(
        self, value: Any, param: click.Parameter | None, ctx: click.Context | None
    ) -> float:
        """The option's value; a usage error if it is not finite or out of range."""
        number: float = super().convert(value, param, ctx)
        if not math.isfinite(number):
            self.fail(f"{number} is not a number in a range.", param, ctx)
        return number


class ModelFile(click.Path):
    """Type of an argument for a model: its file, or the output folder of a training."""

    def __init__(self) -> None:
        super().__init__(path_type=Path)

    def convert(self, value: Any, param: click.Parameter | None, ctx: click.Context | None) -> Path:
        """The file; of an output folder that of the highest iteration, which is named on stderr."""
        path: Path = super().convert(value, param, ctx)  # type: ignore[assignment]
        if not os.path.isdir(path):  # also of too long a name
            return path
        from fragprune_plugins.workbench.scenes.output import newest_model

        try:
            found = newest_model(path)
        except ModelFileError as error:
            self.fail(f"'{path}' is {error.found}. {error.remedy}", param, ctx)
        if launched().first:
            click.echo(printable(f"Model: {found}"), err=True)
        return found


MODEL = ModelFile()


def _logs(
    ctx: click.Context, param: click.Parameter, words: tuple[str, ...]
) -> tuple[tuple[str, str], ...]:
    """Kind and place of each log."""
    places = []
    for word in words:
        kind, _, place = word.partition(":")
        if kind not in ("csv", "tensorboard", "wandb") or not place:
            wanted = "csv:FILE, tensorboard:FOLDER or wandb:PROJECT"
            raise click.BadParameter(f"'{word}' is not {wanted}.", ctx, param)
        places.append((kind, place))
    return tuple(places)


def log_option(function: Function) -> Function:
    """The option ``--log``: the steps that the command takes are written there."""

    @click.option(
        "--log",
        "logs",
        metavar="KIND:PLACE",
        callback=_logs,
        multiple=True,
        help="Write every step's loss, fragments, pressure and threshold to csv:FILE, "
        "tensorboard:FOLDER or wandb:PROJECT. May be given several times.",
    )
    @functools.wraps(function)
    def logged(*args: Any, logs: tuple[tuple[str, str], ...], **kwargs: Any) -> Any:
        if not logs or not launched().first:
            return function(*args, **kwargs)
        from fragprune_plugins.workbench.commands.logs import logging_steps

        with logging_steps(logs):
            return function(*args, **kwargs)

    return logged  # type: ignore[return-value]


def _read_config(ctx: click.Context, param: click.Parameter, value: Path | None) -> Path | None:
    """Make a TOML file's values the defaults of the command's options."""
    if value is None:
        return None
    if sys.version_info >= (3, 11):
        import tomllib
    else:
        import tomli as tomllib

    from fragprune_plugins.files.reading import MEBIBYTE, Door

    remedy = "Write one option a line, such as target-speedup = 2."
    door = Door(UsageError, "not readable as TOML", "a TOML file", remedy, limit=MEBIBYTE)
    try:
        with door.reading(value) as reading:
            values = tomllib.loads(reading.text())
    except UsageError as error:
        raise click.BadParameter(str(error), ctx, param) from error
    options = {
        word.lstrip("-"): each
        for each in ctx.command.params
        if isinstance(each, click.Option) and each is not param
        for word in each.opts
        if word.startswith("--")
    }
    names: dict[str, Any] = {}
    for key, setting in values.items():
        word = key.replace("_", "-")
        if word not in options:
            raise click.BadParameter(
                f"{value}: {key!r} is no option of {ctx.command_path}.", ctx, param
            )
        try:
            names[str(options[word].name)] = _as_words(options[word], setting)
        except ValueError as error:
            raise click.BadParameter(f"{value}: {key}: {error}", ctx, param) from error
    ctx.default_map = {**(ctx.default_map or {}), **names}
    return value


def _as_words(option: click.Option, setting: Any) -> Any:
    """What a line would say in place of a TOML value, so that both are read alike.

    Raises:
        ValueError: no line can say it.
    """
    if isinstance(setting, bool) != option.is_flag or isinstance(setting, list) != option.multiple:
        kind = "true or false" if option.is_flag else "a list" if option.multiple else "one value"
        raise ValueError(f"{setting!r:.80}, where {kind} belongs")
    if option.is_flag:
        return setting
    words = setting if option.multiple else [setting]
    if not all(isinstance(word, str | int | float) and "\0" not in str(word) for word in words):
        raise ValueError(f"{setting!r:.80}, where text or a number belongs")
    return [str(word) for word in words] if option.multiple else str(setting)


config_option = click.option(
    "--config",
    type=FILE,
    is_eager=True,
    expose_value=False,
    callback=_read_config,
    help="TOML file with options of this command, such as target-speedup = 2; those on the command "
    "line go before.",
)


def require_place(out: Path, model: Path, *, thresholds: bool = True) -> None:
    """Check, before any work, that ``out`` can be written and is not ``model``.

    Args:
        out: the model to write, of any format.
        model: the model to read.
        thresholds: whether ``out`` is to have thresholds.

    Raises:
        UsageError: ``out`` and ``model`` have the same name, or of two PLYs the same sidecar.
        OutputError: ``out`` cannot be written, or its format cannot hold thresholds.
    """
    from fragprune_plugins.files.atomic import writable_folder
    from fragprune_plugins.workbench.models import formats

    form = formats.named(out)
    if thresholds:
        formats.expect_carrier(form, out)
    own, other = out.resolve(), model.resolve()
    if form.paired and other.suffix.lower() == ".ply":
        own, other = own.with_suffix(""), other.with_suffix("")
    if own == other:
        raise UsageError(
            "--out", f"{out}, the model's name", "another name", "Choose another name."
        )
    writable_folder(out.parent)
    if out.is_dir():
        raise OutputError(
            str(out), "a folder", f"a {form.suffix} file", "Name a file in the folder."
        )


def describe_written(out: Path, held: str = "") -> str:
    """What a model was written into, and what its format does not keep.

    Args:
        out: the file.
        held: how it holds thresholds, as words; "" where there are none.
    """
    from fragprune_plugins.workbench.models import formats

    form = formats.named(out)
    kept = f" A {form.suffix} file keeps {form.keeps}." if form.keeps else ""
    return f"Wrote {out}{held}.{kept}"


JSON = "fragprune.json"
"""Key of a bool in the context's ``meta``: stdout gets only one JSON object."""


@dataclass(frozen=True)
class Report:
    """The output of a command.

    Attributes:
        data: the object that --json prints.
        text: the text for a person.
        exit_code: 0; 1 if the check failed; 130 or 143 if learning was interrupted and saved.
    """

    data: dict[str, Any]
    text: str
    exit_code: int = 0


class Command(click.Command):
    """A command whose function returns a ``Report``: prints it and sets the exit code.

    Of several processes one prints; None says that another one reports.

    A ``FragpruneError`` gives exit code 1, a usage error 2, Ctrl-C 130, SIGTERM during learning
    143. Any other exception keeps its traceback.
    """

    def __init__(self, *args: Any, **kwargs: Any) -> None:
        super().__init__(*args, **kwargs)
        self.params.append(
            click.Option(
                ["--json", "as_json"], is_flag=True, help="Print one JSON object on stdout."
            )
        )

    def make_context(
        self,
        info_name: str | None,
        args: list[str],
        parent: click.Context | None = None,
        **extra: Any,
    ) -> click.Context:
        """Parse the words; with --json among them, a usage error is printed as JSON."""
        words = list(args)
        try:
            return super().make_context(info_name, args, parent, **extra)
        except click.UsageError as error:
            raise usage_error(error, words) from error

    def invoke(self, ctx: click.Context) -> Any:
        """Run the command, print its report or error, and exit with its code."""
        as_json = ctx.meta[JSON] = bool(ctx.params.pop("as_json"))
        try:
            with _machine_stated(ctx.command_path):
                report: Report | None = super().invoke(ctx)
        except FragpruneError as error:
            if speaks():
                said = json.dumps({"error": error.as_dict()}) if as_json else str(error)
                click.echo(said, err=not as_json)
            codes: dict[type[FragpruneError], int] = {
                UsageError: 2,
                Interrupted: 130,
                Terminated: EXIT_CODE,
            }
            ctx.exit(codes.get(type(error), 1))
        except KeyboardInterrupt as error:
            if speaks():
                click.echo("Interrupted.", err=True)
            ctx.exit(EXIT_CODE if isinstance(error, Terminate) else 130)
        if report is None:
            ctx.exit(0)
        click.echo(json.dumps(strict(report.data)) if as_json else printable(report.text))
        ctx.exit(report.exit_code)


class Group(click.Group):
    """Commands under one name; with --json, an unknown one is printed as JSON."""

    def resolve_command(
        self, ctx: click.Context, args: list[str]
    ) -> tuple[str | None, click.Command | None, list[str]]:
        """The command that the first word names, and the other words."""
        words = list(args)
        try:
            return super().resolve_command(ctx, args)
        except click.UsageError as error:
            raise usage_error(error, words) from error


@contextlib.contextmanager
def _machine_stated(where: str) -> Iterator[None]:
    """State what the machine refuses wherever a command meets it: a path, or memory."""
    try:
        os.getcwd()  # where that folder is gone, torch ends the process without a word of ours
        yield
    except OSError as error:
        if not (error.filename or isinstance(error, FileNotFoundError)):  # a closed pipe, for one
            raise
        raise PathError(
            str(error.filename or where),
            error.strerror or str(error),
            "a path that the system takes",
            "Choose another name or place, or free space and permissions there.",
        ) from error
    except (MemoryError, RuntimeError) as error:
        words = str(error).split("\n", 1)[0][:200]
        known = "allocate memory" in words or "out of memory" in words  # torch's, of CPU and GPU
        if not (known or isinstance(error, MemoryError)):
            raise
        raise MemoryLimitError(
            where,
            f"no memory left ({words or 'MemoryError'})",
            "a model and pictures that fit",
            "Close other programs, or lower the pictures' size with --resolution.",
        ) from error


def usage_error(error: click.UsageError, words: list[str]) -> Exception:
    """The exception to raise for a usage error. With --json, prints the error and returns an exit.

    Args:
        error: click's error.
        words: words of the command line. Words after ``--`` belong to the host's command.
    """
    if not speaks():
        return click.exceptions.Exit(2)
    ours = words[: words.index("--")] if "--" in words else words
    if "--json" not in ours:
        return error
    where = error.ctx.command_path if error.ctx else "fragprune"
    stated = UsageError(
        where, error.format_message(), "options of this command", f"Run {where} --help."
    )
    click.echo(json.dumps({"error": stated.as_dict()}))
    return click.exceptions.Exit(2)


def together(*options: Callable[[Function], Function]) -> Callable[[Function], Function]:
    """Several options as one decorator; --help shows them in this order."""

    def decorate(function: Function) -> Function:
        return functools.reduce(lambda f, option: option(f), reversed(options), function)

    return decorate


DATA_HELP = (
    "Scene folder: COLMAP (sparse/, images/), Blender (transforms_*.json) or nerfstudio "
    "(transforms.json)."
)

CAMERAS_HELP = (
    "cameras.json of a 3DGS model, transforms*.json, or nerfstudio's camera_path.json. "
    "Default: the cameras.json that the training of MODEL wrote"
)

TRAINED_ON = "Default: the photographs that MODEL was trained on, by the cfg_args of its host."

image_options = together(
    click.option(
        "--images",
        metavar="NAME",
        default="images",
        show_default=True,
        help="Folder of --data with the images, such as images_4. Without images/, the largest of "
        "images_2, images_4 and images_8 serves.",
    ),
    click.option(
        "--resolution",
        type=click.IntRange(1, 16),
        default=1,
        show_default=True,
        help="Divide the images' sides by this.",
    ),
    click.option(
        "--white-background",
        is_flag=True,
        help="Composite transparent images over white, as the model was trained.",
    ),
)

data_options = together(
    click.option("--data", type=FILE, help=f"{DATA_HELP} {TRAINED_ON}"), image_options
)


def _device(ctx: click.Context, param: click.Parameter, value: str) -> str:
    """Check that a word has the form of a device; ``engines.device_for`` checks that it exists."""
    if not re.fullmatch(r"auto|cpu|cuda(:\d{1,2})?", value):
        raise click.BadParameter(f"{value!r} is not one of auto, cpu, cuda, cuda:N.")
    return value


def engine_option(what: str) -> Callable[[Function], Function]:
    """The option ``--engine``; ``what`` tells its use in the command's help."""
    names = "auto (the fastest that runs here), reference, cpu, cuda, or a plugin's engine."
    return click.option(
        "--engine", metavar="NAME", default="auto", show_default=True, help=f"{what}: {names}"
    )


def device_option(what: str, default: str = "auto") -> Callable[[Function], Function]:
    """The option ``--device``; ``what`` is its help."""
    return click.option(
        "--device",
        metavar="auto|cpu|cuda[:N]",
        callback=_device,
        default=default,
        show_default=True,
        help=what,
    )


threads_option = click.option(
    "--threads", type=click.IntRange(min=1), help="Number of CPU threads; default: all cores."
)

engine_options = together(
    engine_option("Engine that rasterizes"),
    device_option("Device; auto takes a GPU if our cuda engine can draw on it, else the CPU."),
    threads_option,
)

truncation_option = click.option(
    "--no-truncation", is_flag=True, help="Ignore the thresholds stored with the model."
)

views_option = click.option(
    "--views",
    type=click.Choice(["test", "train", "all"]),
    default="test",
    show_default=True,
    help="Views to use; test means the held-out views (COLMAP: every 8th).",
)


def cameras_of(model: Path) -> Path | None:
    """The cameras that a host wrote beside a model, if its output folder has them."""
    from fragprune_plugins.workbench.scenes.output import CAMERAS, output_folder

    folder = output_folder(model)
    found = None if folder is None else folder / CAMERAS
    return found if found is not None and found.is_file() else None


def photographs_for(
    model: Path,
    data: Path | None,
    images: str,
    resolution: int,
    white_background: bool,
    *,
    remedy: str = "Name the scene's folder with --data.",
) -> Photographs:
    """The photographs that the options name; without --data those that the model was trained on.

    Options that were given override what the training says.

    Raises:
        UsageError: there is no folder, and the model lies in no output folder with arguments.
        DatasetError: the training's arguments cannot be read.
    """
    from fragprune_plugins.hosts.photographs import Photographs, Resolution
    from fragprune_plugins.workbench.scenes.output import ARGUMENTS, trained_on

    if data is not None:
        return Photographs(data, Resolution(resolution), white_background, images)
    known = trained_on(model)
    if known is None:
        raise UsageError(
            "--data",
            f"no folder, and no {ARGUMENTS} of a training around {model}",
            "photographs",
            remedy,
        )
    given = click.get_current_context().get_parameter_source
    changed: dict[str, Any] = {}
    if given("images") is not ParameterSource.DEFAULT:
        changed["images"] = images
    if given("resolution") is not ParameterSource.DEFAULT:
        changed["resolution"] = Resolution(resolution)
    if white_background:
        changed["white_background"] = True
    said = f"Photographs: {known.folder}, which the model was trained on"
    click.echo(printable(said), err=True)
    return replace(known, **changed)


def bound_threads(threads: int | None) -> None:
    """Limit torch and the engines to this many CPU threads; None sets no limit."""
    if threads is not None:
        import torch

        torch.set_num_threads(threads)


@contextlib.contextmanager
def one_voice() -> Iterator[None]:
    """Inside, only the first of several processes prints."""
    if launched().first:
        yield
        return
    with (
        open(os.devnull, "w") as nowhere,
        contextlib.redirect_stdout(nowhere),
        contextlib.redirect_stderr(nowhere),
    ):
        yield


shard_option = click.option(
    "--shard-gaussians",
    "shard",
    is_flag=True,
    help="Under torchrun: divide MODEL's Gaussians among the processes, for a model that does not "
    "fit one GPU. Without it each process holds them all.",
)


def require_several() -> None:
    """Raise UsageError unless this is one of several processes: --shard-gaussians divides."""
    if not launched().several:
        raise UsageError(
            "--shard-gaussians",
            "one process",
            "several, among which Gaussians can be divided",
            "Start with torchrun --nproc_per_node N -m fragprune_plugins, or leave it out.",
        )


def open_engine(engine: str, device: str, threads: int | None) -> tuple[Engine, torch.device]:
    """Open the engine of the options.

    Args:
        engine: the ``--engine`` option.
        device: the ``--device`` option.
        threads: limit on CPU threads; None for no limit.

    Returns:
        The engine, and the device for models and views.

    Raises:
        UsageError: the device does not exist.
        EngineError: the engine does not exist or cannot run here.
    """
    from fragprune_plugins.engines import device_for
    from fragprune_plugins.plugins.hooks import engine_for

    bound_threads(threads)
    where = device_for(device, engine)
    if launched().several and device in ("auto", "cuda") and where.type == "cuda":
        where = device_for(f"cuda:{local_rank()}", engine)
    return engine_for(engine, where), where


def load_shots(
    photographs: Photographs, views: str, device: torch.device | str = "cpu"
) -> Sequence[Shot]:
    """Load the views of a scene folder onto a device.

    Args:
        photographs: the scene, and how its images are read.
        views: "test", "train" or "all".
        device: the device of the views.

    Raises:
        DatasetError: the folder cannot be read as a scene.
    """
    from fragprune_plugins.workbench.scenes.dataset import load_photographs

    dataset = load_photographs(photographs).to(device)
    return {
        "test": dataset.test,
        "train": dataset.train,
        "all": [*dataset.train, *dataset.test],
    }[views]


def dropping(out: Path, bytes_before: int, before: int, after: int) -> dict[str, int]:
    """Counts of dropped Gaussians and bytes, for --json.

    Args:
        out: the file without the dropped Gaussians.
        bytes_before: size of the file with all Gaussians.
        before: number of all Gaussians.
        after: number of Gaussians left.
    """
    return {
        "gaussians": before - after,
        "of": before,
        "bytes_before": bytes_before,
        "bytes_after": out.stat().st_size,
    }


def describe_dropped(dropped: dict[str, int], why: str) -> str:
    """The counts of ``dropping`` as a line of text; ``why`` describes the dropped Gaussians."""
    return (
        f"Dropped {dropped['gaussians']:,} of {dropped['of']:,} Gaussians, {why}: "
        f"{dropped['bytes_before']:,} -> {dropped['bytes_after']:,} bytes."
    )
