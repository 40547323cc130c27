"""3DGS-MCMC: relocation, addition and noise, on a miniature of the host."""

from __future__ import annotations

import json
import sys
from dataclasses import replace

import pytest
import torch
from miniatures import runs
from miniatures.mcmc import MCMCHost
from miniatures.runs import OPTIONS, edit, frozen_differences, written
from miniatures.vanilla_3dgs import (
    expect_ancestors,
    identity,
    joint,
    label,
)

from fragprune_mcmc import MCMC
from fragprune_plugins.errors import AlignmentError, HostFailed, UsageError
from fragprune_plugins.files import sidecar
from fragprune_plugins.files.ply import read_ply
from fragprune_plugins.hosts.source import HostRepo
from fragprune_plugins.injection.launch import run

COUNT = 24


@pytest.fixture(scope="module")
def mini(tmp_path_factory):
    return written(MCMCHost, tmp_path_factory.mktemp("mcmc"))


def of(mini, **options):
    return {"path": mini, "adapter": MCMC()} | options


# -- which host ----------------------------------------------------------------------------------


MODEL = "scene/gaussian_model.py"


@pytest.mark.parametrize(
    ("file", "old", "new", "code"),
    [
        ("utils/reloc_utils.py", "compute_relocation", "another", "other-host"),
        ("gaussian_renderer/__init__.py", "radii, is_used =", "radii =", "rasterizer-call"),
        (
            "gaussian_renderer/__init__.py",
            "GaussianRasterizationSettings(",
            "S(",
            "rasterizer-call",
        ),
    ],
)
def test_a_changed_host_is_refused_by_what_changed(tmp_path, file, old, new, code):
    edit(written(MCMCHost, tmp_path) / file, old, new)
    match = MCMC().match(HostRepo(tmp_path))
    assert [f.code for f in match.findings if f.level == "error"] == [code]


# -- rows ----------------------------------------------------------------------------------------


def test_relocated_rows_and_their_parents_start_without_moments(mini):
    """The host empties its parents' moments; ours of the row that is no more go as well."""
    with joint(**of(mini)) as host:
        model = host.model(COUNT)
        host.step(model, host.camera(), 1)
        label(host, model)
        dead = torch.arange(COUNT) % 3 == 0
        with torch.no_grad():
            model.relocate_gs(dead_mask=dead)
        touched = torch.isin(torch.arange(COUNT), identity(model)[dead]) | dead
        moments = host.store(model).state_dict()["exp_avg"]
        assert (identity(model)[dead] % 3 != 0).all()
        assert torch.equal(moments != 0, ~touched)
        assert torch.equal(identity(model)[~dead], torch.arange(COUNT)[~dead])


def test_parents_of_a_relocation_are_not_taken_for_those_of_a_later_append(mini):
    with joint(**of(mini)) as host:
        model = host.model(COUNT)
        host.step(model, host.camera(), 1)
        with torch.no_grad():
            model.relocate_gs(dead_mask=torch.arange(COUNT) < 2)
            groups = model.optimizer.param_groups
            strangers = [torch.rand_like(group["params"][0][:2]) for group in groups]
            model.densification_postfix(*strangers)  # the groups' order is its parameters'
        values = host.store(model).values.detach()
        assert len(values) == COUNT + 2
        assert (values[-2:] < 1e-12).all()  # neutral: nobody's children


def test_a_relocation_that_copies_otherwise_is_refused(mini, monkeypatch):
    with joint(**of(mini)) as host:
        model = host.model(COUNT)
        host.step(model, host.camera(), 1)
        label(host, model)
        kind = type(model)
        params = kind._update_params

        def shuffled(self, idxs, ratio):
            xyz, colours, *rest = params(self, idxs, ratio)
            return xyz, colours.flip(0), *rest

        monkeypatch.setattr(kind, "_update_params", shuffled)
        before = host.store(model).state_dict()["logits"]
        with torch.no_grad(), pytest.raises(AlignmentError, match="its relocation differs"):
            model.relocate_gs(dead_mask=torch.arange(COUNT) < 9)
        assert torch.equal(host.store(model).state_dict()["logits"], before)
        label(host, model)
        with torch.no_grad():
            monkeypatch.undo()
            model.relocate_gs(dead_mask=torch.arange(COUNT) < 9)  # nothing was left pending
        expect_ancestors(host, model)


def test_the_dialect_gives_three_outputs_and_thresholds_leave_radii_and_use_alone(mini):
    with joint(**of(mini)) as host:
        model, camera = host.model(COUNT), host.camera()
        host.step(model, camera, 1)
        with_thresholds = host.render(camera, model)
        with host.paused():
            without = host.render(camera, model)
    for package in (with_thresholds, without):
        assert package["is_used"].dtype == torch.int32
        assert torch.equal(package["is_used"] > 0, package["visibility_filter"])
    assert torch.equal(with_thresholds["radii"], without["radii"])


# -- stage 2 -------------------------------------------------------------------------------------

MOVES = {
    "opacity": {"opacity"},
    "appearance": {"opacity", "f_dc", "f_rest"},
    "all": {"xyz", "f_dc", "f_rest", "opacity", "scaling", "rotation"},
}


def command(mini, scene, out, iterations, *more):
    words = runs.command(mini / "train.py", scene, out, iterations, "--noise_lr", 5e7)
    return [*words, *map(str, more)]


CAP = ("--cap_max", 170)


def test_train_then_finetune_moves_no_frozen_bit(mini, photographs, tmp_path):
    """The schedule of relocation lasts into stage 2, and the noise would go on for ever."""
    more = (*CAP, "--densify_until_iter", 99)
    summary = run(command(mini, photographs, tmp_path / "out", 12, *more), OPTIONS)
    assert (summary.adapter, summary.iterations) == ("mcmc", 8)
    assert 150 < summary.gaussians <= 170
    assert frozen_differences(summary.model_before, summary.model_after) == []
    store, info = sidecar.load(summary.model_after)
    assert len(store) == summary.gaussians == len(read_ply(summary.model_after).xyz)
    assert info.adapter == "mcmc"
    assert summary.fragments_after < summary.fragments_before


def test_joint_learning_through_relocation_and_addition(mini, photographs, tmp_path):
    options = replace(OPTIONS, stage="joint", from_iter=3)
    summary = run(command(mini, photographs, tmp_path / "out", 20, *CAP), options)
    store, _ = sidecar.load(summary.model_after)
    assert len(store) == len(read_ply(summary.model_after).xyz) > 150
    assert not store.neutral


def test_frozen_from_an_iteration_on(mini, photographs, tmp_path):
    options = replace(OPTIONS, stage="finetune", from_iter=12)
    more = (*CAP, "--checkpoint_iterations", 12, "--densify_until_iter", 99)
    out = tmp_path / "out"
    summary = run(command(mini, photographs, out, 20, *more), options)
    capture, _ = torch.load(out / "chkpnt12.pth", weights_only=False)
    assert torch.equal(capture[1].detach(), read_ply(summary.model_after).xyz)


# -- the host's own refusals, and files over the command line --------------------------------------


def test_a_host_that_ends_early_with_success_is_a_stated_failure(mini, photographs, tmp_path):
    with pytest.raises(HostFailed, match="without a checkpoint of iteration 12"):
        run(command(mini, photographs, tmp_path / "out", 12), OPTIONS)
    assert "scene" not in sys.modules


def test_what_stage_two_changes_wins_over_the_configuration_file(mini, photographs, tmp_path):
    config, out = tmp_path / "scene.json", tmp_path / "out"
    values = {"cap_max": 170, "iterations": 12, "model_path": str(out), "noise_lr": 1.0}
    config.write_text(json.dumps(values))
    summary = run(command(mini, photographs, "elsewhere", 5, "--config", config), OPTIONS)
    assert summary.model_before == out / "point_cloud" / "iteration_12" / "point_cloud.ply"
    assert summary.model_after == out / "point_cloud" / "iteration_21" / "point_cloud.ply"
    assert 150 < summary.gaussians <= 170
    assert json.loads(config.read_text()) == values


@pytest.mark.parametrize("text", [None, "{"], ids=["missing", "broken"])
def test_a_configuration_file_that_cannot_be_read_is_refused(mini, photographs, tmp_path, text):
    config = tmp_path / "scene.json"
    if text:
        config.write_text(text)
    with pytest.raises(UsageError, match="a file the host can read"):
        run(command(mini, photographs, tmp_path / "out", 12, "--config", config), OPTIONS)
