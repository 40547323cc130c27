"""A real host's training and stage 2 after it, in a process of their own."""

import sys
from collections.abc import Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from pathlib import Path
from types import ModuleType, SimpleNamespace
from typing import Any

import torch

from fragprune_plugins.errors import HostFailed
from fragprune_plugins.files import sidecar
from fragprune_plugins.files.ply import read_ply
from fragprune_plugins.injection.launch import RunOptions, run
from fragprune_plugins.learning.schedule import Settings

STEPS = 6
NAMES = ("xyz", "f_dc", "f_rest", "scaling", "rotation", "opacity")
CAPTURED = {
    **dict(zip(NAMES, range(1, 7), strict=True)),
    **{"t": 13, "scaling_t": 14, "rotation_r": 15},
}
"""Where RT-4DGS, which has no PLY, keeps its tensors in a checkpoint."""


@dataclass(frozen=True)
class Learned:
    """What stage 2 left: the tensors that moved, by name, and the models' files before and after.

    ``rows`` are of the models and the thresholds, ``steps`` of stage 2 and the thresholds.
    """

    moved: list[str]
    rows: tuple[int, int, int]
    steps: tuple[int, int]
    fragments: tuple[float, float]
    models: tuple[Path, Path]


def learned(words: Sequence[str], stage: str, checkpoint: int = 0) -> Learned:
    """Run a host's training script with stage 2.

    Where a host's training ends in an error of its own, stage 2 begins at the checkpoint before.
    """
    without_torchvision()
    settings = Settings(iterations=STEPS, threshold_lr=0.3, train="opacity")
    options = RunOptions(device="cpu", stage=stage, settings=settings)
    if checkpoint:
        with suppress(HostFailed):
            run([*words, "--checkpoint_iterations", str(checkpoint)], replace(options, stage="off"))
        options = replace(options, stage="finetune")
    summary = run(words, options)
    files = summary.model_before, summary.model_after
    (before, _), (after, thresholds) = map(state, files)
    return Learned(
        moved=[name for name in before if not torch.equal(before[name], after[name])],
        rows=(len(before["xyz"]), len(after["xyz"]), thresholds["rows"]),
        steps=(summary.steps, thresholds["steps"]),
        fragments=(summary.fragments_before, summary.fragments_after),
        models=files,
    )


def state(file: Path) -> tuple[dict[str, torch.Tensor], dict[str, int]]:
    """The tensors of a model's file, and the number of its thresholds and of their steps."""
    if file.suffix == ".pth":
        capture, _ = torch.load(file, weights_only=False)
        kept = capture[11].get("fragprune", {"logits": (), "steps": 0})
        tensors = {name: capture[place] for name, place in CAPTURED.items()}
        return tensors, {"rows": len(kept["logits"]), "steps": kept["steps"]}
    model, network = read_ply(file, filtered=True), file.with_name("deformation.pth")
    tensors = {name: getattr(model, name) for name in NAMES}
    if network.exists():
        tensors |= torch.load(network, weights_only=True)
    store = sidecar.load(file)[0] if sidecar.find(file) else ()
    return tensors, {"rows": len(store), "steps": getattr(store, "steps", 0)}


def without_torchvision() -> None:
    """Stand in for packages that hosts import and only pictures or metrics of theirs use."""

    def no_weights(*given: Any, **named: Any) -> Any:
        raise OSError("not downloaded in a test")

    torch.hub.load_state_dict_from_url = no_weights
    models = SimpleNamespace(VGG16_Weights=SimpleNamespace(IMAGENET1K_V1=None), vgg16=no_weights)
    for name, members in {
        "torchvision": {"models": models, "utils": None},
        "icecream": {"ic": lambda *values: None},
    }.items():
        try:
            __import__(name)
        except Exception:  # torchvision is not made for every torch
            sys.modules[name] = module = ModuleType(name)
            module.__path__ = []
            vars(module).update(members)
