"""The options of learning, for ``run`` and ``finetune``."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, get_args

import click

from fragprune_plugins.errors import UsageError
from fragprune_plugins.learning import pressure, schedule
from fragprune_plugins.learning.goals import Control, Fewer, Goal, Portable, Pressure
from fragprune_plugins.learning.schedule import Settings, steps_of
from fragprune_plugins.types import Rim
from fragprune_plugins.workbench.commands.options import Function, Number, bundled
from fragprune_plugins.workbench.commands.rules import Alone, apart
from fragprune_plugins.workbench.goals import AtMost, Faster


def _stop(value: str) -> float | str | None:
    """A stop as an option gives it: a share of light, auto, or off, which is None."""
    words = {"auto": "auto", "off": None}
    return words[value] if value in words else click.FLOAT(value)


_OPTIONS = (
    click.option(
        "--iters", type=int, help=f"Iterations of stage 2; default {schedule.FINETUNE_ITERATIONS}."
    ),
    click.option(
        "--quick",
        is_flag=True,
        help=f"Run {schedule.QUICK_ITERATIONS} iterations, for most of the gain.",
    ),
    click.option(
        "--train",
        type=click.Choice(["opacity", "appearance", "all"]),
        default="all",
        help="Parameters that learn with the cutoffs: opacities alone, as in the paper; "
        "appearance adds SH; all adds shapes and positions, and truncates in the last 2,000 "
        "iterations only.",
    ),
    click.option(
        "--pressure",
        type=float,
        help="Weight of drawn fragments per pixel in the loss; default: "
        f"{2 * pressure.ELASTICITY:g} of the loss per fragment ({pressure.ELASTICITY:g} unless all "
        "parameters learn in stage 2), from "
        f"{pressure.LEAST_PRESSURE:g} to {pressure.MOST_PRESSURE:g}.",
    ),
    click.option(
        "--target-speedup",
        type=float,
        help="Target for the ratio of fragments: those of the original without cutoffs, "
        "divided by those drawn now, on the training views that calibration measures.",
    ),
    click.option(
        "--portable",
        is_flag=True,
        help="For viewers that ignore cutoffs: learn none, and press on the area that the "
        "Gaussians cover instead of on drawn fragments. --pressure is its weight then; default: "
        f"{pressure.PORTABLE_ELASTICITY:g} of the loss per pixel of area.",
    ),
    click.option(
        "--stop",
        type=_stop,
        metavar="SHARE|auto|off",
        default="auto",
        help="A pixel draws the fragment that leaves less than this share of its light, and ends "
        f"there. auto: the model's own; else {schedule.USUAL_STOP:g} where cutoffs learn from "
        "photographs. off: add none. A number also works with --control.",
    ),
    click.option(
        "--rim",
        type=click.Choice(get_args(Rim)),
        help="How a Gaussian ends at its cutoff: hard between two pixels, or soft across one, "
        "without aliasing. Default: as the model has it, else hard. Soft rims need the cpu engine.",
    ),
    click.option(
        "--dropout",
        type=Number(0, 0.9),
        metavar="SHARE",
        help="Leave so many of the Gaussians out of a step, others in each, such as 0.2; falls to "
        "0 over the run. For a model that knows its photographs by heart; finetune then begins "
        "with four times the usual learning rates. Default: 0, but finetune, and run before stage "
        "2, try whether the model is such a one.",
    ),
    click.option(
        "--control", is_flag=True, help="Run the same iterations without pruning, to compare with."
    ),
)

LEARNING_APART = (
    Alone(("--quick", "--iters")),
    Alone(
        ("--control", "--portable", "--target-speedup", "--target-time", "--max-drop"), "one goal"
    ),
    Alone(("--control", "--pressure"), "one goal"),
    *apart("--pressure", "--target-speedup", "--target-time", "--max-drop", expected="one goal"),
    Alone(
        ("--log", "--max-drop"),
        "one training, whose steps are written once: --max-drop makes up to eight",
    ),
)
"""Rules of commands with these options."""

_OF_FINETUNE = (
    click.option(
        "--target-time",
        type=float,
        help="Target for the ratio of frame times: those of the original without cutoffs, divided "
        "by those now, on this machine, at the size of the training views. 1.5 means frames 1.5 "
        "times as fast.",
    ),
    click.option(
        "--max-drop",
        type=Number(0, 10),
        metavar="DB",
        help="Find the strongest pruning that loses at most so much PSNR, in dB, against the "
        "control. Trains the control and up to 7 times more, and chooses the pressure on the "
        "held-out views.",
    ),
)
"""Goals that need a model of before to time frames against, or several trainings."""


def learning_options(*, every_goal: bool) -> Callable[[Function], Function]:
    """The options of learning, which a command gets as ``settings``, with its own ``seed``,
    ``itself`` and ``views_per_step``. A host's training cannot meet every goal.
    """
    options = _OPTIONS + _OF_FINETUNE if every_goal else _OPTIONS
    return bundled(lambda given: {"settings": _settings(given)}, *options)


def _settings(given: dict[str, Any]) -> Settings:
    itself, views = given.get("itself", False), given.pop("views_per_step", 1)
    iters, quick = given.pop("iters"), given.pop("quick")
    short = schedule.QUICK_ITERATIONS if quick or itself else schedule.FINETUNE_ITERATIONS
    try:
        return Settings(
            iterations=steps_of(short, views) if iters is None else iters,
            goal=_goal(given),
            itself=itself,
            seed=given.get("seed", 0),
            views_per_step=views,
            **{name: given.pop(name) for name in ("train", "stop", "rim", "dropout")},
        )
    except UsageError as error:  # name the option whose value is refused
        where = _SPELLED.get(error.where, error.where)
        raise UsageError(where, error.found, error.expected, error.remedy) from error


_SPELLED = {
    "iterations": "--iters",
    "views per step": "--views-per-step",
    "pressure": "--pressure",
    "target speed-up": "--target-speedup",
    "target time": "--target-time",
    "largest loss": "--max-drop",
    "stop": "--stop",
}
"""Options by the names that errors give them."""


def _goal(given: dict[str, Any]) -> Goal:
    """The one goal that options name; ``LEARNING_APART`` sees to it that they name no two."""
    weight, portable, control = map(given.pop, ("pressure", "portable", "control"))
    kinds: dict[str, Any] = {"target_speedup": Fewer, "target_time": Faster, "max_drop": AtMost}
    numbers = {name: given.pop(name, None) for name in kinds}
    goals: list[Goal] = [kinds[k](number) for k, number in numbers.items() if number is not None]
    if goals:
        return goals[0]
    if control:
        return Control()
    return Portable(weight) if portable else Pressure(weight)
