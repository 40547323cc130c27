"""What all commands share: --json, errors and exit codes, the options for scenes and engines."""

from __future__ import annotations

import functools
import json
import re
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypeVar

import click

from fragprune_plugins.errors import (
    FragpruneError,
    Interrupted,
    OutputError,
    Terminated,
    UsageError,
)
from fragprune_plugins.learning.interruption import EXIT_CODE, Terminate
from fragprune_plugins.storage.records import strict

if TYPE_CHECKING:
    import torch

    from fragprune_plugins.datasets.dataset import Shot
    from fragprune_plugins.datasets.photographs import Resolution
    from fragprune_plugins.engines import Engine

Function = TypeVar("Function", bound=Callable[..., Any])

FILE = click.Path(path_type=Path)


class OutFile(click.Path):
    """A file to write, refused before any work unless its name says what will be in it.

    Args:
        suffix: that its name must have, in lower or upper case.
    """

    def __init__(self, suffix: str) -> None:
        super().__init__(path_type=Path)
        self.suffix = suffix

    def convert(self, value: Any, param: click.Parameter | None, ctx: click.Context | None) -> Path:
        """The path, if its name fits."""
        path: Path = super().convert(value, param, ctx)  # type: ignore[assignment]
        if path.suffix.lower() != self.suffix:
            self.fail(f"'{path}' is no name for it: a {self.suffix} file is written.", param, ctx)
        return path


def require_place(out: Path, model: Path) -> None:
    """Prove, before any work, that a model can be written at ``out``, and is not ``model`` again.

    Raises:
        UsageError: both have one name, and so one sidecar.
        OutputError: it cannot be written.
    """
    from fragprune_plugins.storage.atomic import writable_folder

    if out.resolve().with_suffix("") == model.resolve().with_suffix(""):
        raise UsageError("--out", f"{out}, named as the model is", "another name", "Choose one.")
    writable_folder(out.parent)
    if out.is_dir():
        raise OutputError(str(out), "a folder", "a .ply file", "Name a file in it.")


JSON = "fragprune.json"
"""Key in the context's meta: whether stdout is kept for one JSON object."""


@dataclass(frozen=True)
class Report:
    """What a command has to say.

    Attributes:
        data: for --json.
        text: for a person.
        exit_code: 0, or 1 when what was asked for was not reached, or 130 or 143.
    """

    data: dict[str, Any]
    text: str
    exit_code: int = 0


class Command(click.Command):
    """A command that returns a ``Report``: prints it, as JSON if asked; turns errors into codes.

    1 for a stated failure, 2 for usage, 130 for Ctrl-C, 143 for SIGTERM while something learned.
    Anything unforeseen keeps its traceback.
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
        """Read the words; what is wrong with them is said as JSON where that was asked for."""
        words = list(args)
        try:
            return super().make_context(info_name, args, parent, **extra)
        except click.UsageError as error:
            raise usage_error(error, words) from error

    def invoke(self, ctx: click.Context) -> Any:
        """Run, print, and leave with the right exit code."""
        as_json = ctx.meta[JSON] = bool(ctx.params.pop("as_json"))
        try:
            report: Report = super().invoke(ctx)
        except FragpruneError as error:
            if as_json:
                click.echo(json.dumps({"error": error.as_dict()}))
            else:
                click.echo(str(error), err=True)
            codes: dict[type[FragpruneError], int] = {
                UsageError: 2,
                Interrupted: 130,
                Terminated: EXIT_CODE,
            }
            ctx.exit(codes.get(type(error), 1))
        except KeyboardInterrupt as error:
            click.echo("Interrupted.", err=True)
            ctx.exit(EXIT_CODE if isinstance(error, Terminate) else 130)
        click.echo(json.dumps(strict(report.data)) if as_json else report.text)
        ctx.exit(report.exit_code)


def usage_error(error: click.UsageError, words: list[str]) -> Exception:
    """What to raise for a usage error: itself, or an exit once it was printed as JSON.

    Args:
        error: click's.
        words: as typed; those after ``--`` are the host's, ``--json`` among them.
    """
    ours = words[: words.index("--")] if "--" in words else words
    if "--json" not in ours:
        return error
    where = error.ctx.command_path if error.ctx else "fragprune"
    stated = UsageError(
        where, error.format_message(), "options it understands", f"Run {where} --help."
    )
    click.echo(json.dumps({"error": stated.as_dict()}))
    return click.exceptions.Exit(2)


def _together(*options: Callable[[Function], Function]) -> Callable[[Function], Function]:
    """Several options as one decorator, shown in this order."""

    def decorate(function: Function) -> Function:
        return functools.reduce(lambda f, option: option(f), reversed(options), function)

    return decorate


image_options = _together(
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

data_options = _together(
    click.option(
        "--data",
        type=FILE,
        required=True,
        help="Scene folder: COLMAP (sparse/, images/) or Blender (transforms_*.json).",
    ),
    image_options,
)


def _device(ctx: click.Context, param: click.Parameter, value: str) -> str:
    """A word that ``engines.device_for`` knows; whether the device is here is for it to say."""
    if not re.fullmatch(r"auto|cpu|cuda(:\d{1,2})?", value):
        raise click.BadParameter(f"{value!r} is not one of auto, cpu, cuda, cuda:N.")
    return value


def engine_option(what: str) -> Callable[[Function], Function]:
    """``--engine``; what it does here."""
    names = "auto (the fastest that runs here), reference, cpu, cuda, or the name of a plugin's."
    return click.option(
        "--engine", metavar="NAME", default="auto", show_default=True, help=f"{what}: {names}"
    )


def device_option(what: str, default: str = "auto") -> Callable[[Function], Function]:
    """``--device``; what it does here."""
    return click.option(
        "--device",
        metavar="auto|cpu|cuda[:N]",
        callback=_device,
        default=default,
        show_default=True,
        help=what,
    )


threads_option = click.option(
    "--threads", type=click.IntRange(min=1), help="CPU threads; all cores when left out."
)

engine_options = _together(
    engine_option("What rasterizes"),
    device_option("Where; auto takes a GPU on which our cuda engine may be used, else the CPU."),
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
    help="Which views to use; test are those held out (COLMAP: every 8th).",
)


def bound_threads(threads: int | None) -> None:
    """Let torch, and the engines with it, take so many CPU threads; None leaves them all."""
    if threads is not None:
        import torch

        torch.set_num_threads(threads)


def open_engine(engine: str, device: str, threads: int | None) -> tuple[Engine, torch.device]:
    """The engine that was asked for, and the device to put models and views on.

    Bounds the CPU threads of torch and of the engines, which follow torch.

    Raises:
        UsageError: there is no such device.
        EngineError: there is no such engine.
    """
    from fragprune_plugins.engines import device_for
    from fragprune_plugins.plugins.hooks import engine_for

    bound_threads(threads)
    where = device_for(device, engine)
    return engine_for(engine, where), where


def load_shots(
    folder: Path,
    views: str,
    *,
    resolution: int | Resolution,
    white_background: bool,
    images: str = "images",
    device: torch.device | str = "cpu",
) -> Sequence[Shot]:
    """The views of a scene folder that were asked for, on a device.

    Raises:
        DatasetError: the folder cannot be read as a scene.
    """
    from fragprune_plugins.datasets.dataset import load_dataset

    dataset = load_dataset(
        folder, resolution=resolution, white_background=white_background, images=images
    ).to(device)
    return {
        "test": dataset.test,
        "train": dataset.train,
        "all": [*dataset.train, *dataset.test],
    }[views]


def dropping(out: Path, bytes_before: int, before: int, after: int) -> dict[str, int]:
    """What leaving Gaussians out of a file did: to its bytes, and to their count."""
    return {
        "gaussians": before - after,
        "of": before,
        "bytes_before": bytes_before,
        "bytes_after": out.stat().st_size,
    }


def describe_dropped(dropped: dict[str, int], why: str) -> str:
    """The same in a line."""
    return (
        f"Dropped {dropped['gaussians']:,} of {dropped['of']:,} Gaussians, {why}: "
        f"{dropped['bytes_before']:,} -> {dropped['bytes_after']:,} bytes."
    )
