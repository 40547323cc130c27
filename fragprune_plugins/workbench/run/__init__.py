"""``fragprune run``: runs a host's training command and learns cutoffs."""

from __future__ import annotations

import logging
import sys
from typing import Any

import click

from fragprune_plugins.errors import UsageError
from fragprune_plugins.workbench.commands import config, learning, logs, rules
from fragprune_plugins.workbench.commands.command import JSON, WORDS, Command, Report, work_of
from fragprune_plugins.workbench.commands.options import engine_options
from fragprune_plugins.workbench.run import recognising, sweep

_STAGES = ("--stage finetune", "--stage joint")
_INSIDE = "--stage finetune or joint, which learn inside one run"
RULES = (*learning.LEARNING_APART, rules.Needs("--from-iter", _STAGES, _INSIDE))


@click.command("run", cls=Command, rules=RULES, context_settings={"allow_interspersed_args": False})
@click.argument("host_command", nargs=-1, type=click.UNPROCESSED, metavar="-- python train.py ...")
@click.option("--adapter", help="Name of the host's adapter; default: detected from its source.")
@click.option(
    "--stage",
    type=click.Choice(["auto", "finetune", "joint", "off"]),
    default="auto",
    help="auto: train, then fine-tune. finetune: only fine-tune the model in the output folder. "
    "joint: learn inside the training. off: only apply stored cutoffs.",
)
@click.option(
    "--from-iter",
    type=click.IntRange(min=0),
    help="finetune, joint: learn after this iteration; joint's default is the end of densification "
    "by the host's own arguments.",
)
@learning.learning_options(every_goal=False)
@logs.log_option
@config.config_option
@engine_options(
    "Engine that rasterizes with cutoffs, or if the host's own rasterizer is missing",
    device="Device of the host; cpu runs a CUDA-only host without a GPU.",
)
@click.option(
    "--trust",
    is_flag=True,
    help="Go on, with a warning, where the host's own rasterizer draws otherwise than ours, or "
    "could not be compared with it.",
)
@click.option("--again", is_flag=True, help="Train or learn anew, though it is finished.")
def command(**options: Any) -> Report:
    """Train with a host's own command, then learn a cutoff for every Gaussian.

    Put the unmodified command after --. Stage 1 is the host's own training. Stage 2 resumes it for
    a few thousand iterations, in which no Gaussian is added or removed. All parameters learn with
    the cutoffs (but see --train). The host saves its model as usual, and the cutoffs go
    beside it as a sidecar. In stage 2, Ctrl-C (exit code 130) and SIGTERM (143) save the cutoffs
    learned so far. If stage 2 was interrupted or killed, the same command begins it anew and does
    not repeat stage 1.

    If no adapter fits the codebase, but the PLY that it saves is plain 3DGS (fragprune check
    tells), its training runs by itself, and that PLY is then fine-tuned as by fragprune finetune.
    Where that was interrupted, --stage finetune goes on; without it the training runs again.

    The command may be a script that starts trainings, such as full_eval.py or a shell's train.sh:
    each script of a host that it starts by the word python runs as if fragprune run stood in front
    of it, with the same options.

    \b
    Examples:
      fragprune run -- python train.py -s scene -m out --eval
      fragprune run --quick --device cpu -- train.py -s scene -m out --iterations 7000
      fragprune run --stage finetune -- train.py -s scene -m out     (already trained)
      fragprune run --stage joint -- python train.py -s scene -m out   (no added iterations)
      fragprune run -- python render.py -m out                       (renders with cutoffs)
      fragprune run -- bash train_all.sh                             (each training in it)
    """
    if not recognising.is_sweep(options["host_command"]):
        return work_of(__name__, **options)
    context, script = click.get_current_context(), options["host_command"]
    if context.params["logs"]:
        what = " ".join(script)
        raise UsageError("--log", what, "one training, whose steps it writes", "Leave it out.")
    logging.basicConfig(level=logging.INFO, format="fragprune: %(message)s", stream=sys.stderr)
    words = context.meta[WORDS]  # it needs no torch: what it starts imports that
    return sweep.run_sweep(script, words[: len(words) - len(script)], quietly=context.meta[JSON])
