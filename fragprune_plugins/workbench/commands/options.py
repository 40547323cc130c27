"""The options that several commands share, and the values that they become."""

from __future__ import annotations

import functools
import math
import os
import re
from collections.abc import Callable
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any, TypeVar

import click
from click.core import ParameterSource

from fragprune_plugins.errors import ModelFileError, UsageError, printable
from fragprune_plugins.hosts.photographs import Resolution
from fragprune_plugins.workbench.commands.rules import Alone
from fragprune_plugins.workbench.ranks import launched
from fragprune_plugins.workbench.scenes.output import newest_model

Function = TypeVar("Function", bound=Callable[..., Any])
FILE = click.Path(path_type=Path)


class OutFile(click.Path):
    """Type of an option for a file to write; refuses a name without one of some suffixes."""

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

    def convert(self, value: Any, param: click.Parameter | None, ctx: click.Context | None) -> Path:
        """The file; of an output folder that of the highest iteration, which is named on stderr."""
        path: Path = super().convert(value, param, ctx)  # type: ignore[assignment]
        try:
            os.lstat(path)
        except OSError as error:
            missing = isinstance(error, FileNotFoundError)
            found = "no such file" if missing else f"cannot be opened ({error.strerror})"
            expected = "a trained splat, or the output folder of a training"
            raise ModelFileError(str(path), found, expected, "Check the path.") from error
        if not os.path.isdir(path):
            return path
        try:
            newest = newest_model(path)
        except ModelFileError as error:
            self.fail(f"'{path}' is {error.found}. {error.remedy}", param, ctx)
        if launched().first:
            click.echo(printable(f"Model: {newest}"), err=True)
        return newest


MODEL = ModelFile(path_type=Path)
Option = Callable[[Any], Any]  # what ``click.option`` gives


def bundled(
    gather: Callable[[dict[str, Any]], dict[str, Any]], *options: Option
) -> Callable[[Function], Function]:
    """Several options as one decorator; --help shows them in this order.

    ``gather`` takes them out of the command's arguments, and returns what it gets in their place.
    """

    def decorate(function: Function) -> Function:
        @functools.wraps(function)
        def gathered(*args: Any, **kwargs: Any) -> Any:
            return function(*args, **gather(kwargs), **kwargs)

        return functools.reduce(lambda f, option: option(f), reversed(options), gathered)  # type: ignore[return-value]

    return decorate


@dataclass(frozen=True)
class EngineOptions:
    """What draws: the options ``--engine``, ``--device`` and ``--threads``."""

    name: str = "auto"
    device: str = "auto"
    threads: int | None = None


def engine_options(
    what: str = "Engine that rasterizes",
    device: str = "Device; auto takes a GPU if our cuda engine can draw on it, else the CPU.",
    default: str = "auto",
) -> Callable[[Function], Function]:
    """The options of ``EngineOptions``, which a command gets as ``engine``."""
    names = "auto (the fastest that runs here), reference, cpu, cuda, or a plugin's engine."
    given = ("engine", "device", "threads")
    return bundled(
        lambda options: {"engine": EngineOptions(*map(options.pop, given))},
        click.option("--engine", metavar="NAME", default="auto", help=f"{what}: {names}"),
        click.option(
            "--device", metavar="auto|cpu|cuda[:N]", callback=_device, default=default, help=device
        ),
        click.option(
            "--threads",
            type=click.IntRange(min=1),
            help="Number of CPU threads; default: all cores.",
        ),
    )


def _device(ctx: click.Context, param: click.Parameter, value: str) -> str:
    """Check that a word has the form of a device; ``engines.device_for`` checks that it exists."""
    if not re.fullmatch(r"auto|cpu|cuda(:\d{1,2})?", value):
        raise click.BadParameter(f"{value!r} is not one of auto, cpu, cuda, cuda:N.")
    return value


DATA_HELP = (
    "Scene folder: COLMAP (sparse/, images/), Blender (transforms_*.json) or nerfstudio "
    "(transforms.json)."
)

CAMERAS_HELP = (
    "cameras.json of a 3DGS model, transforms*.json, or nerfstudio's camera_path.json. "
    "Default: the cameras.json that the training of MODEL wrote"
)

CAMERAS_APART = Alone(("--cameras", "--data", "--orbit", "--inside"), "one source of cameras")
TRAINED_ON = "Default: those that MODEL was trained on, by its record or the cfg_args of its host."


@dataclass(frozen=True)
class SceneOptions:
    """Photographs and their size: ``--data``, ``--images``, ``--resolution`` and so on."""

    data: Path | None = None
    images: str = "images"  # folder of ``data``
    resolution: Resolution = field(default_factory=Resolution)
    white_background: bool = False
    given: frozenset[str] = frozenset()  # names of the options that the user gave

    def as_record(self, cameras: Path | None) -> dict[str, Any]:
        """The cameras of a model's own pictures as plain values, for records."""
        return {
            "data": self.data and str(self.data.resolve()),
            "file": cameras and str(cameras.resolve()),
            "resolution": asdict(self.resolution),
            "white_background": self.white_background,
        }


def scene_options(data: str = f"{DATA_HELP} {TRAINED_ON}") -> Callable[[Function], Function]:
    """The options of ``SceneOptions``, which a command gets as ``scene``."""
    names = ("data", "images", "resolution", "white_background")

    def gather(given: dict[str, Any]) -> dict[str, Any]:
        source = click.get_current_context().get_parameter_source
        chosen = frozenset(name for name in names if source(name) is not ParameterSource.DEFAULT)
        data, images, divide, white = map(given.pop, names)
        return {"scene": SceneOptions(data, images, Resolution(divide), white, chosen)}

    return bundled(
        gather,
        click.option("--data", type=FILE, help=data),
        click.option(
            "--images",
            metavar="NAME",
            default="images",
            help="Folder of --data with the images, such as images_4. Without images/, the "
            "largest of images_2, images_4 and images_8 serves.",
        ),
        click.option(
            "--resolution",
            type=click.IntRange(1, 16),
            default=1,
            help="Divide the images' sides by this.",
        ),
        click.option(
            "--white-background",
            is_flag=True,
            help="Composite transparent images over white, as the model was trained.",
        ),
    )


def _own_pictures(given: dict[str, Any]) -> dict[str, Any]:
    itself, orbit, cameras = map(given.pop, ("itself", "orbit", "cameras"))
    itself = itself or orbit or cameras is not None
    return {"itself": itself, "orbit": orbit, "cameras": cameras}


own_picture_options = bundled(
    _own_pictures,
    click.option(
        "--self",
        "itself",
        is_flag=True,
        help="Measure against the model's own pictures instead of photographs, from the cameras "
        "of --data; else of its training, if it lies in its output folder; else as --orbit.",
    ),
    click.option("--cameras", type=FILE, help="Likewise, from a cameras.json or transforms*.json."),
    click.option("--orbit", is_flag=True, help="Likewise, from cameras all around the model."),
)
"""For what is compared with a model's own pictures. A command gets ``itself``, whether one of them
was given, ``orbit``, and ``cameras``, a file or None. ``CAMERAS_APART`` are its rules.
"""

truncation_option = click.option(
    "--no-truncation", is_flag=True, help="Ignore the cutoffs stored with the model."
)

views_option = click.option(
    "--views",
    type=click.Choice(["test", "train", "all"]),
    default="test",
    help="Views to use; test means the held-out views (COLMAP: every 8th).",
)

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
        expected = "several, among which Gaussians can be divided"
        remedy = "Start with torchrun --nproc_per_node N -m fragprune_plugins, or leave it out."
        raise UsageError("--shard-gaussians", "one process", expected, remedy)
