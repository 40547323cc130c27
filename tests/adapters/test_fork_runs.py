"""Whole runs of a fork of the demo's host, which no adapter names."""

from __future__ import annotations

import shutil

import pytest
import torch
from miniatures import runs
from miniatures.forks import KERNEL
from miniatures.runs import OPTIONS, edit, frozen_differences
from miniatures.vanilla_3dgs import HOST

from fragprune_plugins.files import sidecar
from fragprune_plugins.files.ply import read_ply
from fragprune_plugins.injection.launch import run

MODEL, RENDERER = "scene/gaussian_model.py", "gaussian_renderer/__init__.py"
GROUPS = """
        groups = [
            {"params": [self._opacity], "lr": training_args.opacity_lr, "name": "opacity"},
            {"params": [self._xyz], "lr": rates["xyz"][1], "name": "xyz"},
            {"params": [self._features_dc], "lr": training_args.feature_lr, "name": "f_dc"},
            {"params": [self._features_rest], "lr": rates["f_rest"][1], "name": "f_rest"},
            {"params": [self._scaling], "lr": training_args.scaling_lr, "name": "scaling"},
            {"params": [self._rotation], "lr": training_args.rotation_lr, "name": "rotation"},
        ]
        self.tone = torch.nn.Parameter(torch.zeros(1))
        self.tones = torch.optim.Adam([{"params": [self.tone], "lr": 0.1, "name": "tone"}])
"""
RATES = "        gaussians.update_learning_rate(iteration)\n"
STEP = "                gaussians.optimizer.step()\n"
LOSS = "        loss = (1 - opt.lambda_dssim) * l1_loss(image, truth)\n"
SUMS = "D += depths[collected_id[j]] * alpha * T; out_depth[pix_id] = D;"


@pytest.fixture(params=[True, False], ids=["rates first", "rates last"])
def fork(request, tmp_path):
    """Other groups, optimizers, names and values back, and depth in the loss."""
    root = tmp_path / "fork"
    shutil.copytree(HOST, root)
    model, train = root / MODEL, root / "train.py"
    comprehension = next(line for line in model.read_text().splitlines() if "groups = [{" in line)
    edit(model, f"{comprehension}\n", GROUPS.removeprefix("\n"))
    for file in (model, train):
        edit(file, "densify_and_prune", "renew")
    edit(root / RENDERER, "image, radii = ", "image, depth, radii, touched = ")
    edit(root / RENDERER, '        "radii": radii,\n', RETURNED)
    edit(train, LOSS, f'{LOSS}        loss = loss + 0.01 * package["depth"].mean()\n')
    if not request.param:
        edit(train, RATES, "")
        edit(train, STEP, STEP + RATES.replace("        ", " " * 16))
    package = root / "submodules/a/diff_gaussian_rasterization"
    package.mkdir(parents=True)
    (package / "__init__.py").write_text("")
    (package.parent / "forward.cu").write_text(KERNEL.replace("SUMS", SUMS))
    train.rename(root / "train_scene.py")
    return root


RETURNED = '        "radii": radii,\n        "depth": depth,\n        "touched": touched,\n'


def test_a_fork_is_trained_and_pruned(fork, photographs, tmp_path):
    words = runs.command(fork / "train_scene.py", photographs, tmp_path / "out", 12)
    summary = run(words, OPTIONS)
    assert (summary.iterations, summary.adapter) == (8, "3dgs-fork")
    before, after = read_ply(summary.model_before), read_ply(summary.model_after)
    assert frozen_differences(summary.model_before, summary.model_after) == []
    assert not torch.equal(before.opacity, after.opacity)
    store, _ = sidecar.load(summary.model_after)
    assert (store.steps, len(store)) == (8, len(after.xyz))
    assert summary.fragments_after < summary.fragments_before
    assert [each["step"] for each in summary.curves] == list(range(1, 9))
