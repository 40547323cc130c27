"""``fragprune run -- ns-train splatfacto ...``: the same training, by our method."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

from fragprune_nerfstudio.learning import flags_of
from fragprune_plugins import Settings
from fragprune_plugins.adapting import UsageError

HOST = "splatfacto"
ITERATIONS = 30_000  # nerfstudio's default for splatfacto
LENGTH, MODEL = "--max-num-iterations", "--pipeline.model"
LOADS = ("--load-dir", "--load-checkpoint")
VARIANTS = {
    "splatfacto-big": {
        f"{MODEL}.cull-alpha-thresh": "0.005",
        f"{MODEL}.densify-grad-thresh": "0.0005",
        "--optimizers.bilateral-grid.optimizer.lr": "0.005",
    }
}
"""Methods that are splatfacto with other defaults, as nerfstudio 1.1.5 has them."""


def rewritten(
    method: str,
    arguments: list[str],
    settings: Settings,
    *,
    stage: str,
    from_iter: int | None,
    engine: str,
    device: str,
) -> list[str]:
    """The arguments of ns-train that make stage 2 follow the training that they ask for.

    Args:
        method: the name of our method.
        stage: "auto" for stage 2 after the training, "finetune" for stage 2 alone, of a checkpoint
            or from ``from_iter`` on.

    Raises:
        UsageError: they ask for another method, what ns-train cannot do, or another GPU.
    """
    if not arguments or arguments[0] not in (HOST, method, *VARIANTS):
        found = arguments[0] if arguments else "no method"
        raise UsageError("ns-train", found, HOST, f"Train with: ns-train {HOST} ...")
    kind, _, number = device.partition(":")
    if int(number or 0):
        found, remedy = "ns-train, which names the first GPU", f"Set CUDA_VISIBLE_DEVICES={number}."
        raise UsageError(f"--device {device}", found, "--device cuda", remedy)
    given, rest = _split_off(arguments[1:], LENGTH)
    loads = any(_flag(word) in LOADS for word in rest)
    if any(_flag(word) == "--load-config" for word in rest):
        where, found = "ns-train --load-config", "a configuration that replaces all other flags"
        remedy = f"Name the checkpoints with {LOADS[0]}, and give the other flags again."
        raise UsageError(where, found, "flags alone", remedy)
    if stage not in ("auto", "finetune"):
        remedy = "Drop --stage; ns-eval, ns-export and the viewer need no fragprune run."
        raise UsageError(f"--stage {stage}", "ns-train", "auto or finetune", remedy)
    total = ITERATIONS if given is None else given
    ours: dict[str, Any] = dict(VARIANTS.get(arguments[0], {}))
    if from_iter is not None:
        if from_iter >= total:
            remedy = f"Lower it, or raise {LENGTH}."
            raise UsageError("--from-iter", str(from_iter), f"less than {total}", remedy)
        settings = replace(settings, iterations=total - from_iter)
        ours[f"{MODEL}.fragprune-from"] = from_iter
    elif stage == "auto":
        total += settings.iterations
    elif loads:
        total = settings.iterations
    else:
        expected = f"{LOADS[0]} with a run's nerfstudio_models"
        remedy = f"Add {LOADS[0]} to the command, or --from-iter."
        raise UsageError("--stage finetune", "no checkpoint to start from", expected, remedy)
    ours |= {f"{MODEL}.fragprune.{name}": value for name, value in flags_of(settings).items()}
    if engine != "auto":
        ours[f"{MODEL}.fragprune-engine"] = engine
    ours |= {LENGTH: total, "--machine.device-type": kind}
    flags = [word for flag, value in ours.items() for word in (flag, str(value))]
    return [method, *flags, *rest]


def _flag(word: str) -> str:
    """The flag that a word names, as nerfstudio's help spells it."""
    return word.split("=")[0].replace("_", "-") if word.startswith("--") else ""


def _split_off(words: list[str], flag: str) -> tuple[int | None, list[str]]:
    """(the last value of a number's flag, the words without it)."""
    value: Any = None
    rest: list[str] = []
    waiting = iter(words)
    for word in waiting:
        if _flag(word) != flag:
            rest.append(word)
            continue
        value = word.partition("=")[2] if "=" in word else next(waiting, "")
        if not value.isdigit():
            raise UsageError(flag, repr(value), "a number of iterations", "Correct it.")
    return None if value is None else int(value), rest
