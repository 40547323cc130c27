"""Whole runs of a miniature's own scripts, and what must not have moved in them."""

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from PIL import Image

from fragprune_plugins import Settings, load_dataset, rasterize
from fragprune_plugins.files import sidecar
from fragprune_plugins.files.ply import read_ply
from fragprune_plugins.injection.launch import RunOptions
from fragprune_plugins.testing import Host
from fragprune_plugins.workbench.commands.options import EngineOptions
from fragprune_plugins.workbench.figures.evaluate import Candidate
from fragprune_plugins.workbench.run.work import measure_models, photographs_of

TINY = [
    *("-r", "1", "--sh_degree", "1", "--eval"),
    *("--densify_from_iter", "4", "--densification_interval", "5"),
    *("--densify_until_iter", "18", "--densify_grad_threshold", "0.0008"),
    *("--opacity_reset_interval", "3000", "--test_iterations", "-1"),
]
"""Flags with which a run of a few dozen iterations densifies and prunes."""

OPTIONS = RunOptions(device="cpu", settings=Settings(8, threshold_lr=0.3, train="opacity"))
OFF, FINETUNE = (replace(OPTIONS, stage=stage) for stage in ("off", "finetune"))
FROZEN = ("xyz", "f_dc", "f_rest", "scaling", "rotation")


def written(host: type[Host], root: Path) -> Path:
    """The folder, a miniature now."""
    host().write(root)
    return root


def miniature(host: type[Host], adapter: type, **defaults: type) -> tuple[Any, Any]:
    """A fixture with a miniature, and a function for the words of a session there."""

    @pytest.fixture(scope="module")
    def mini(tmp_path_factory: pytest.TempPathFactory) -> Path:
        return written(host, tmp_path_factory.mktemp("mini"))

    def of(mini: Path, **options: Any) -> dict[str, Any]:
        made = {name: kind() for name, kind in defaults.items()}
        return {"path": mini, "adapter": adapter()} | made | options

    return mini, of


def command(script: Path, scene: object, out: object, iterations: int, *more: object) -> list[str]:
    """The words that train on a scene."""
    words = [script, "-s", scene, "-m", out, "--iterations", iterations, *TINY, *more]
    return [str(word) for word in words]


def frozen_differences(before: Path, after: Path) -> list[str]:
    """In which tensors two files of a model differ, opacities aside."""
    one, other = read_ply(before), read_ply(after)
    return [name for name in FROZEN if not torch.equal(getattr(one, name), getattr(other, name))]


def check_stage_two(summary: Any, adapter: str) -> None:
    """Of a finished run with ``OPTIONS``: opacities moved alone, each row has its threshold."""
    before, after = summary.model_before, summary.model_after
    assert (summary.adapter, summary.steps) == (adapter, 8)
    assert frozen_differences(before, after) == []
    assert not torch.equal(read_ply(before).opacity, read_ply(after).opacity)
    store, info = sidecar.load(after)
    assert len(store) == info.rows == summary.gaussians == len(read_ply(after).opacity)
    assert (info.adapter, store.steps, store.neutral) == (adapter, 8, False)
    assert summary.fragments_after < summary.fragments_before


def check_measured(summary, picture, photographs, read):
    """The picture of the one held-out view that a host's script rendered is what we measure."""
    values = sidecar.load(summary.model_after)[0].values.detach()
    candidate = Candidate(read(summary.model_after), summary.drawing)
    (shot,) = load_dataset(photographs).test
    with torch.no_grad():
        image = rasterize(candidate.inputs(shot.view), values).image
    pixels = (image.clamp(0, 1) * 255 + 0.5).byte().permute(1, 2, 0).numpy()
    theirs = np.asarray(Image.open(picture))
    assert np.abs(pixels.astype(int) - theirs).max() <= 1  # a camera's float32, rounded
    assert (pixels != theirs).mean() < 0.05
    _, (before, after) = measure_models(photographs_of(summary), EngineOptions())
    assert after["fragments_per_pixel"] < before["fragments_per_pixel"]


def edit(file: Path, old: str, new: str) -> None:
    """Replace a passage of a miniature's source, which must be there."""
    text = file.read_text()
    assert old in text
    file.write_text(text.replace(old, new))
