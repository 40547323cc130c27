"""The options of everything that learns, ``run`` and ``finetune`` alike."""

from __future__ import annotations

import functools
from collections.abc import Callable
from typing import Any

import click

from fragprune_plugins.errors import UsageError
from fragprune_plugins.learning.pressure import ELASTICITY, LEAST_PRESSURE
from fragprune_plugins.learning.schedule import FINETUNE_ITERATIONS, QUICK_ITERATIONS, Settings

_OPTIONS = (
    click.option(
        "--iters", type=int, help=f"Iterations of stage 2; default {FINETUNE_ITERATIONS}."
    ),
    click.option("--quick", is_flag=True, help=f"{QUICK_ITERATIONS} iterations: most of the gain."),
    click.option(
        "--train",
        type=click.Choice(["opacity", "appearance", "all"]),
        default="opacity",
        show_default=True,
        help="What learns beside the thresholds; appearance adds SH, all adds shapes and "
        "positions.",
    ),
    click.option(
        "--pressure",
        type=float,
        help=f"Weight of drawn fragments per pixel in the loss; default {ELASTICITY:g} of the loss "
        f"per fragment, {LEAST_PRESSURE:g} or more.",
    ),
    click.option(
        "--target-speedup",
        type=float,
        help="Steer for this many times fewer fragments: those of the untruncated model as it came "
        "in over those drawn now, on the training views that calibration measures.",
    ),
    click.option(
        "--control", is_flag=True, help="Same iterations without truncation: the honest zero."
    ),
)

_EXCLUDE = (
    ("--quick", "--iters"),
    ("--pressure", "--target-speedup"),
    ("--control", "--pressure"),
    ("--control", "--target-speedup"),
)


def learning_options(function: Callable[..., Any]) -> Callable[..., Any]:
    """Add the options; the command gets one ``settings`` for them (and for ``seed``, if it has it).

    Raises:
        UsageError: options that contradict each other, or values out of range.
    """

    @functools.wraps(function)
    def with_settings(
        *args: Any,
        iters: int | None,
        quick: bool,
        train: Any,
        pressure: float | None,
        target_speedup: float | None,
        control: bool,
        **kwargs: Any,
    ) -> Any:
        asked = {
            "--quick": quick,
            "--iters": iters is not None,
            "--pressure": pressure is not None,
            "--target-speedup": target_speedup is not None,
            "--control": control,
        }
        for one, other in _EXCLUDE:
            if asked[one] and asked[other]:
                raise UsageError("options", f"{one} with {other}", "one of the two", "Drop one.")
        default = QUICK_ITERATIONS if quick else FINETUNE_ITERATIONS
        settings = Settings(
            iterations=default if iters is None else iters,
            train=train,
            pressure=pressure,
            target_speedup=target_speedup,
            truncate=not control,
            seed=kwargs.get("seed", 0),
        )
        return function(*args, settings=settings, **kwargs)

    return functools.reduce(lambda f, option: option(f), reversed(_OPTIONS), with_settings)
