"""``fragprune finetune``: learns a trained splat's cutoffs from photographs, or from itself."""

from __future__ import annotations

import contextlib
from typing import Any

import click

from fragprune_plugins.workbench.commands import options as shared
from fragprune_plugins.workbench.commands.command import (
    Command,
    Report,
    first_process_prints,
    work_of,
)
from fragprune_plugins.workbench.commands.config import config_option
from fragprune_plugins.workbench.commands.learning import LEARNING_APART, learning_options
from fragprune_plugins.workbench.commands.logs import log_option
from fragprune_plugins.workbench.commands.rules import Alone, Needs, apart
from fragprune_plugins.workbench.models import formats
from fragprune_plugins.workbench.ranks import launched


def _share(ctx: click.Context, param: click.Parameter, value: str | None) -> float | str | None:
    """A share in (0, 1], or a word."""
    if value in (None, "auto", "visible"):
        return value
    with contextlib.suppress(ValueError):
        if 0 < float(value) <= 1:
            return float(value)
    raise click.BadParameter(f"{value!r} is not auto, visible or a number with 0 < X <= 1.")


_PARTS = "options that each process can follow with a part of the Gaussians"

RULES = (
    *LEARNING_APART,
    Alone(("--data", "--cameras"), "one source of cameras"),
    Needs("--cameras", ("--self",), "the model's own pictures, which those cameras show"),
    Alone(("--self", "--max-drop"), "photographs, and with them a control to lose against"),
    Alone(
        ("--self", "--control"),
        "something to learn: without pruning the model is its own target already",
    ),
    Alone(("--self", "--keep auto"), "photographs, whose error says what can be spared"),
    *apart("--shard-gaussians", "--self", "--portable", expected=_PARTS),
    *apart("--shard-gaussians", "--max-drop", "--keep", expected=_PARTS),
)


@click.command("finetune", cls=Command, rules=RULES)
@click.argument("model", type=shared.MODEL)
@click.option(
    "--out",
    type=shared.OutFile(*formats.ENDINGS),
    required=True,
    help="New model: .ply, .spz, .sog or .glb, which hold its cutoffs. .splat and "
    ".compressed.ply cannot hold any.",
)
@click.option(
    "--self",
    "itself",
    is_flag=True,
    help="Learn from MODEL's own pictures instead of photographs. Cameras: those of --data or "
    "--cameras; else of its training, if MODEL lies in its output folder; else all around MODEL, "
    "which suits an object. Indoor scenes and streets need cameras: generated ones stay outside.",
)
@click.option(
    "--cameras",
    type=shared.FILE,
    help="With --self: cameras.json of a 3DGS model, or transforms_*.json; every 8th is held out.",
)
@shared.scene_options()
@learning_options(every_goal=True)
@log_option
@config_option
@click.option(
    "--keep",
    metavar="SHARE|auto|visible",
    callback=_share,
    help="Before learning, remove Gaussians until this share is left, such as 0.8: first those "
    "whose removal least changes what training views, and others beside them, show. auto keeps "
    "what the photographs need, and moves those worth least to where some are missing, while it "
    "learns; visible keeps what reaches a pixel of any view. "
    "--target-speedup counts from what is left.",
)
@click.option("--seed", type=int, default=0, help="Seed of the order of views.")
@click.option(
    "--views-per-step",
    type=click.IntRange(min=1),
    default=lambda: launched().size,
    show_default="one for each process",
    metavar="N",
    help="Views whose mean loss a step descends on. Without --iters, steps are N times fewer; "
    "learning rates are the square root of N times higher. More than one serves several "
    "processes under torchrun, which draw them side by side.",
)
@shared.shard_option
@shared.truncation_option
@click.option(
    "--again", is_flag=True, help="Begin anew, though OUT is finished or there is a checkpoint."
)
@shared.engine_options()
@first_process_prints()
def command(**options: Any) -> Report | None:
    """Learn how far each Gaussian of MODEL must reach.

    Cutoffs and all other parameters adapt to each other on the photographs in --data. With
    --train opacity, positions, shapes and colours stay bit for bit. OUT has the columns of
    3DGS, and one more for the cutoffs, trunc_threshold. The table compares both models on
    held-out views. A line below it measures OUT without its cutoffs, as other viewers draw it.
    Ctrl-C (exit code 130) and SIGTERM (143) save what was learned so far.

    The same command goes on where it was interrupted or killed. If OUT is finished already, it says
    so and does nothing; --again begins anew.

    With --portable no cutoffs are learned: the Gaussians themselves cover less area, and every
    viewer draws OUT as it is. "area per pixel" in the table is what most web
    viewers pay for: the pixels in all ellipses of sqrt(8) standard deviations.

    With --self no photograph is read: MODEL's own pictures are what it must go on showing, also
    between the cameras. PSNR is against those pictures then. The defaults are 1000 iterations at
    --pressure 1.5e-4.

    A MODEL that knows its photographs by heart shows them much better than what lies between them.
    100 steps on half of them tell: if the others get worse by 0.05 dB, --dropout 0.2 --keep 0.6
    keep cutoffs from suiting the photographs alone; if not, --keep auto removes what they can
    spare, and moves other Gaussians to where some are missing.

    \b
    Examples:
      fragprune finetune point_cloud.ply --data scene --out pruned.ply --quick
      fragprune finetune point_cloud.ply --data scene --out half.ply --target-speedup 2
      fragprune finetune point_cloud.ply --data scene --out fast.ply --target-time 1.4
      fragprune finetune point_cloud.ply --data scene --out good.ply --max-drop 0.05
      fragprune finetune point_cloud.ply --data scene --out zero.ply --control
      fragprune finetune point_cloud.ply --data scene --out light.ply --portable
      fragprune finetune point_cloud.ply --data scene --out small.ply --keep 0.6
      fragprune finetune statue.ply --self --out pruned.ply
      fragprune finetune statue.spz --self --out pruned.spz
      fragprune finetune point_cloud.ply --self --cameras cameras.json --out pruned.ply
    """
    return work_of(__name__, **options)
