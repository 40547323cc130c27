"""A look at the model of stage 1: stage 2 begins with what it finds, and learns as it says."""

import logging
import shutil
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from miniatures import runs
from miniatures.hosts import HOSTS
from miniatures.runs import FINETUNE, FROZEN, OFF, OPTIONS
from plyfile import PlyData

from fragprune_graphdeco import GraphdecoAdapter
from fragprune_plugins.files import sidecar
from fragprune_plugins.files.ply import read_ply
from fragprune_plugins.injection.launch import run
from fragprune_plugins.injection.starting import part_of
from fragprune_plugins.learning.goals import Control
from fragprune_plugins.workbench.models.model import load

ENDED = ("--densify_until_iter", 8)
"""Before the last iteration, as in every training that ends."""

POINTS = ("--depth_interval", 6, "--num_depth", 240, "--simp_iteration2", 9)
"""Mini-Splatting's new points from depth, and its second simplification."""

RESUMED = (
    ("2dgs", "train.py"),
    ("3dgs-fork", "train_scene.py"),
    ("light-gaussian", "train_densify_prune.py", "--prune_iterations", 9),
    ("lp-3dgs", "train.py"),
    ("mcmc", "train.py", "--cap_max", 170),
    ("mini-splatting", "gs/train.py"),
    ("mini-splatting", "ms/train.py", "--imp_metric", "indoor", "--simp_iteration1", 8, *POINTS),
    ("mini-splatting", "ms_d/train.py", *POINTS),
    ("mip-splatting", "train.py"),
    ("rain-gs", "train.py"),
    ("speedy-splat", "train.py", "--prune_until_iter", 0),
    ("vanilla-3dgs", "train.py"),
)
"""Hosts whose models are looked at, with the script and what its command needs besides."""

FROM_PLY = ("2dgs", "light-gaussian", "mip-splatting", "vanilla-3dgs")
"""Of these also from a PLY alone: further columns, another optimizer, other scales."""


class Looked:
    """Keeps every second Gaussian, and remembers what it was shown."""

    def __init__(self):
        self.seen = []

    def __call__(self, ply, photographs, drawing, settings):
        self.seen.append((ply, photographs, drawing, settings))
        kept = torch.arange(len(load(ply, filtered=True))) % 2 == 0
        return replace(settings, dropout=0.25), kept


@pytest.fixture(scope="module")
def stage_one(photographs, tmp_path_factory):
    """A finished stage 1 of vanilla, of ten iterations, and its command."""
    folder = tmp_path_factory.mktemp("host")
    script, out = runs.written(HOSTS["vanilla-3dgs"], folder) / "train.py", folder / "out"
    words = runs.command(script, photographs, out, 10, *ENDED, "--checkpoint_iterations", 10)
    run(words, OFF)
    return words, out


@pytest.fixture
def trained(stage_one, tmp_path):
    """The command in a copy of its output folder."""
    words, out = stage_one
    copy = Path(shutil.copytree(out, tmp_path / "out"))
    return [str(copy) if word == str(out) else word for word in words]


@pytest.mark.parametrize(
    ("alone", "host", "script", "more"),
    [
        (alone, host, script, more)
        for host, script, *more in RESUMED
        for alone in ((False, True) if host in FROM_PLY else (False,))
    ],
)
def test_stage_two_begins_with_what_is_kept(alone, host, script, more, photographs, tmp_path):
    folder, look = runs.written(HOSTS[host], tmp_path / "host"), Looked()
    words = runs.command(folder / script, photographs, tmp_path / "out", 10, *ENDED, *more)
    if alone:
        run(words, OFF)
    written = {path: path.read_bytes() for path in tmp_path.rglob("out/**/*.p*")}
    summary = run(words, replace(OPTIONS, look=look, stage="finetune" if alone else "auto"))
    ((shown, _, drawing, _),) = look.seen
    assert (shown, drawing) == (summary.model_before, summary.drawing)
    before, after = (load(p, filtered=True) for p in (summary.model_before, summary.model_after))
    for name in FROZEN:
        assert torch.equal(getattr(after, name), getattr(before, name)[::2]), name
    store, info = sidecar.load(summary.model_after)
    assert info.adapter == host
    assert len(store) == summary.gaussians == len(after.xyz)
    assert info.settings["dropout"] == summary.settings["dropout"] == 0.25
    assert {path: path.read_bytes() for path in written} == written


def test_a_stage_two_that_a_look_changed_is_finished_when_asked_again(trained):
    options = replace(FINETUNE, again=False, look=Looked())
    assert run(trained, options).steps == 8
    again = replace(options, look=Looked())
    finished = run(trained, again)
    assert finished.already_finished
    assert finished.settings["dropout"] == 0.25
    assert again.look.seen == []
    other = replace(options, settings=replace(options.settings, dropout=0.5))
    assert not run(trained, other).already_finished


@pytest.mark.parametrize("resumes_ply", [True, False])
def test_a_ply_is_resumed_where_the_checkpoint_has_other_gaussians(
    resumes_ply, photographs, tmp_path, caplog, monkeypatch
):
    """The host densifies in the iteration in which it writes both; some cannot resume a PLY."""
    monkeypatch.setattr(GraphdecoAdapter, "resumes_ply", resumes_ply)
    script, look = runs.written(HOSTS["vanilla-3dgs"], tmp_path / "host") / "train.py", Looked()
    words = runs.command(script, photographs, tmp_path / "out", 10)
    with caplog.at_level(logging.INFO, logger="fragprune"):
        summary = run(words, replace(OPTIONS, look=look))
    before, after = (read_ply(p).xyz for p in (summary.model_before, summary.model_after))
    assert len(look.seen) == resumes_ply
    assert ("without a look at the model" in caplog.text) != resumes_ply
    assert torch.equal(after, before[::2]) if resumes_ply else len(after) > len(before)


def test_a_ply_is_resumed_where_rows_of_the_checkpoint_are_other_gaussians(trained):
    """3DGS-MCMC relocates in place: as many rows, some of them elsewhere."""
    checkpoint, look = Path(trained[4]) / "chkpnt10.pth", Looked()
    capture, iteration = torch.load(checkpoint, weights_only=False)
    with torch.no_grad():
        capture[1][3] += capture[1].max()
    torch.save((capture, iteration), checkpoint)
    summary = run(trained, replace(FINETUNE, look=look))
    before, after = (read_ply(p).xyz for p in (summary.model_before, summary.model_after))
    assert torch.equal(after, before[::2])


def test_a_control_is_looked_at_as_its_training_is(trained):
    control = replace(OPTIONS.settings, goal=Control())
    options = replace(FINETUNE, settings=control, look=Looked())
    run(trained, options)
    assert [settings.goal for *_, settings in options.look.seen] == [control.goal]


def test_a_part_of_a_checkpoint_has_the_rows_of_its_gaussians(stage_one, tmp_path):
    _, out = stage_one
    whole, iteration = torch.load(out / "chkpnt10.pth", weights_only=False)
    kept = torch.arange(len(whole[1])) % 3 == 0
    part, same = torch.load(part_of(out / "chkpnt10.pth", kept, tmp_path), weights_only=False)
    assert same == iteration
    rows = len(kept)
    for one, other in zip(leaves(whole), leaves(part), strict=True):
        assert type(one) is type(other)
        if torch.is_tensor(one) and one.shape[:1] == (rows,):
            assert torch.equal(other, one[kept])
            assert other.requires_grad == one.requires_grad
        elif torch.is_tensor(one):
            assert torch.equal(other, one)
        else:
            assert other == one
    counted = [each for each in leaves(part) if torch.is_tensor(each) and len(each.shape) > 1]
    assert len(counted) >= 3 * 6  # six parameters and two moments of each


def test_arrays_that_a_checkpoint_counts_gaussians_in_are_cut_like_its_tensors(tmp_path):
    kept, rows = torch.tensor([True, False, True]), torch.arange(3)
    state = {"param_groups": [], "seen": rows.numpy(), "scenes": np.arange(2.0), "name": "a"}
    torch.save(((rows, state), 10), tmp_path / "chkpnt10.pth")
    (tmp_path / "part").mkdir()
    path = part_of(tmp_path / "chkpnt10.pth", kept, tmp_path / "part")
    (tensor, part), _ = torch.load(path, weights_only=False)
    assert tensor.tolist() == part["seen"].tolist() == [0, 2]
    assert isinstance(part["seen"], np.ndarray)
    assert part["scenes"].tolist() == [0, 1]


def test_a_part_of_a_ply_has_all_its_columns(stage_one, tmp_path):
    ply = stage_one[1] / "point_cloud/iteration_10/point_cloud.ply"
    whole = PlyData.read(ply)["vertex"].data
    kept = torch.arange(len(whole)) % 3 == 0
    part = PlyData.read(part_of(ply, kept, tmp_path))["vertex"].data
    assert part.dtype == whole.dtype
    assert np.array_equal(part, whole[kept.numpy()])


def leaves(value):
    if isinstance(value, dict):
        return [leaf for each in value.values() for leaf in leaves(each)]
    if isinstance(value, list | tuple):
        return [leaf for each in value for leaf in leaves(each)]
    return [value]
