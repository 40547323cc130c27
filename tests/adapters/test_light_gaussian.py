"""LightGaussian: counts, pruning and distillation, on a miniature of the host."""

import copy
import shutil
from dataclasses import replace
from importlib import import_module
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
import torch
from miniatures import runs
from miniatures.light_gaussian import LightGaussianHost
from miniatures.runs import FINETUNE, OPTIONS, check_stage_two, frozen_differences, miniature
from miniatures.vanilla_3dgs import expect_ancestors, joint, label, running
from oracle import naive

from fragprune_light_gaussian import LightGaussian
from fragprune_plugins import Control
from fragprune_plugins.adapting import hookimpl, read_ply
from fragprune_plugins.files import sidecar
from fragprune_plugins.hosts.adapter import optimizer_state
from fragprune_plugins.injection.launch import run
from fragprune_plugins.learning.schedule import Settings
from fragprune_plugins.testing.invariants.case import FixedThresholds

COUNT = 16


mini, of = miniature(LightGaussianHost, LightGaussian)


def brute_force(inputs, thresholds):
    """(N,) fragments of each Gaussian, by loops over floats."""
    splats, counts = naive.splats_of(inputs, thresholds), [0] * len(inputs.splats)
    for y in range(inputs.view.height):
        for x in range(inputs.view.width):
            for record in naive.records_at(splats, x, y)[0]:
                counts[record.row] += record.drawn
    return counts


@pytest.mark.parametrize("truncated", [False, True], ids=["whole", "truncated"])
@pytest.mark.parametrize("size", [(24, 18), (33, 17)])
def test_both_forms_of_the_call_against_brute_force(mini, truncated, size):
    notes = FixedThresholds()
    with joint(**of(mini, plugins=[notes])) as host:
        model, camera = host.model(COUNT), host.camera(*size)
        host.step(model, camera, 1)
        store = host.store(model)
        with torch.no_grad():
            store.logits.copy_(torch.linspace(-4, -0.5, COUNT))
        plain = host.render(camera, model)
        pipe = SimpleNamespace(debug=False, compute_cov3D_python=False, convert_SHs_python=False)
        count = import_module("gaussian_renderer").count_render
        if truncated:
            package = count(camera, model, pipe, torch.zeros(3))
        else:
            with host.paused():
                package = count(camera, model, pipe, torch.zeros(3))
                plain = host.render(camera, model)
        expected = brute_force(notes.inputs, store.values.detach() if truncated else None)
    counts, scores = package["gaussians_count"], package["important_score"]
    assert counts.dtype == torch.int32
    assert counts.tolist() == expected
    assert sum(expected) > 100
    opacities = notes.inputs.splats.opacities.tolist()
    by_fragment = [sum([o] * n) for o, n in zip(opacities, expected, strict=True)]
    assert scores.tolist() == pytest.approx(by_fragment, rel=1e-5)
    assert scores.dtype == torch.float32
    assert not any(package[name].requires_grad for name in ("render", "important_score"))
    assert plain["render"].requires_grad
    torch.testing.assert_close(package["render"], plain["render"].detach(), rtol=1e-6, atol=1e-6)
    assert torch.equal(package["radii"], plain["radii"])
    counts += counts  # as the host adds views up, in place
    scores += scores


@pytest.mark.parametrize("bands", [0, 1])
def test_a_point_cloud_read_with_fewer_bands_has_its_thresholds(mini, tmp_path, bands):
    path = tmp_path / "point_cloud.ply"
    with joint(**of(mini)) as host:
        model = host.model(COUNT)
        label(host, model)
        model.save_ply(str(path))
    with running(**of(mini), learn=False) as host:
        model = host.model(5, setup=False)
        model.load_ply_sh(str(path), bands)
        expect_ancestors(host, model)
        assert host.render(host.camera(), model)["render"].isfinite().all()


def test_the_rate_of_stage_two_is_not_the_hosts_schedulers(mini):
    with running(Settings(iterations=9, opacity_lr=0.02, train="opacity"), **of(mini)) as host:
        model, rates = host.model(COUNT), []
        model.scheduler = torch.optim.lr_scheduler.ExponentialLR(model.optimizer, gamma=0.5)
        model.optimizer.register_step_pre_hook(
            lambda optimizer, *_: rates.append({g["name"]: g["lr"] for g in optimizer.param_groups})
        )
        for iteration in (1, 2, 3):
            host.step(model, host.camera(), iteration)
            model.scheduler.step()
        expected = [host.schedule.at(step).opacity_lr for step in (1, 2, 3)]
        assert [rate["opacity"] for rate in rates] == expected


def command(mini, script, scene, out, iterations, *more):
    return runs.command(mini / script, scene, out, iterations, *more)


@pytest.fixture(scope="module")
def trained(mini, photographs, tmp_path_factory):
    """Trained with pruning, then fine-tuned; a checkpoint of each stage."""
    out = tmp_path_factory.mktemp("trained")
    words = command(mini, "train_densify_prune.py", photographs, out, 20, "--sh_degree", 2)
    words += ["--prune_iterations", "15", "18", "22", "--checkpoint_iterations", "29"]
    return run(words, OPTIONS), out


def test_training_resumes_itself_and_pruning_stands_still(trained):
    summary, out = trained
    check_stage_two(summary, "light-gaussian")  # though --prune_iterations names 22
    before, after = summary.model_before, summary.model_after
    assert (before.parent.name, after.parent.name) == ("iteration_20", "iteration_29")
    assert np.load(out / "imp_score.npz")["arr_0"].shape == (summary.gaussians,)


@pytest.mark.parametrize("given", ["checkpoint", "point cloud"])
def test_pruning_is_stage_one_of_its_own_script(mini, photographs, trained, tmp_path, given):
    summary, out = trained
    at = 29 if given == "checkpoint" else 0
    words = command(mini, "prune_finetune.py", photographs, tmp_path, at + 6, "--sh_degree", 2)
    words += ["--prune_percent", "0.3", "--prune_iterations", str(at + 1)]
    if given == "checkpoint":
        words += ["--start_checkpoint", str(out / "chkpnt29.pth")]
    else:
        words += ["--start_pointcloud", str(summary.model_after)]
        shutil.copy(out / "chkpnt29.pth", tmp_path)  # of another run, and later
    again = run(words, OPTIONS)
    assert again.gaussians < 0.75 * summary.gaussians
    assert again.steps == 8
    names = [path.parent.name for path in (again.model_before, again.model_after)]
    assert names == [f"iteration_{at + 6}", f"iteration_{at + 15}"]
    assert frozen_differences(again.model_before, again.model_after) == []
    stage1, stage2 = (sidecar.load(path)[0] for path in (again.model_before, again.model_after))
    assert (stage1.steps, stage2.steps) == (8, 16)  # thresholds came along and learned on
    settings = replace(OPTIONS.settings, goal=Control())
    control = run(words, replace(OPTIONS, stage="finetune", settings=settings))
    assert (control.model_before, control.gaussians) == (again.model_before, again.gaussians)


def test_a_checkpoint_made_of_a_point_cloud_has_the_hosts_weight_decay(trained, tmp_path):
    LightGaussian().checkpoint_from_ply(trained[0].model_after, 29, tmp_path / "made.pth")
    (capture, _) = torch.load(tmp_path / "made.pth", weights_only=False)
    state = optimizer_state(capture, "checkpoint")
    assert {group["weight_decay"] for group in state["param_groups"]} == {0.01}


def test_finetune_alone_resumes_the_checkpoint_of_pruning(mini, photographs, trained, tmp_path):
    """Asked for stage 2 only, the host's pruning is what has to wait."""
    summary, out = trained
    words = command(mini, "prune_finetune.py", photographs, tmp_path, 40, "--sh_degree", 2)
    words += ["--prune_iterations", "30", "--start_checkpoint", str(out / "chkpnt29.pth")]
    again = run(words, FINETUNE)
    assert (again.gaussians, again.steps) == (summary.gaussians, 8)
    assert frozen_differences(summary.model_after, again.model_after) == []


def distilling(mini, photographs, out, trained, iterations, *more):
    checkpoint = trained[1] / "chkpnt29.pth"
    words = command(mini, "distill_train.py", photographs, out, iterations, "--sh_degree", 2)
    words += ["--start_checkpoint", str(checkpoint), "--teacher_model", str(checkpoint)]
    return [*words, "--new_max_sh", "1", *more]


def degree_two(out):
    """Checkpoints of short runs stand at band 0; distillation takes a band away."""
    capture, iteration = torch.load(out / "chkpnt29.pth", weights_only=False)
    torch.save(((2, *capture[1:]), iteration), out / "chkpnt29.pth")


def test_distillation_is_resumed_by_the_training_script(mini, photographs, trained, tmp_path):
    degree_two(trained[1])
    words = distilling(mini, photographs, tmp_path, trained, 33, "--augmented_view")
    summary = run(words, OPTIONS)
    assert summary.steps == 8
    assert [read_ply(p).sh_degree for p in (summary.model_before, summary.model_after)] == [1, 1]
    assert summary.model_after.parent.name == "iteration_42"
    assert frozen_differences(summary.model_before, summary.model_after) == []
    files = summary.model_before, trained[0].model_after
    student, teacher = (sidecar.load(each)[0] for each in files)
    assert torch.equal(student.logits, teacher.logits)  # applied while distilling, not learned


class Teachers:
    def __init__(self):
        self.stores = []

    @hookimpl
    def fragprune_attached(self, model, store):
        if not any(store is each for each in self.stores):
            self.stores.append(store)


def test_a_teacher_is_drawn_with_its_own_thresholds_and_never_trained(mini):
    notes = Teachers()
    with joint(**of(mini, plugins=[notes])) as host:
        teacher, student = host.model(COUNT), host.model(COUNT)
        label(host, teacher)
        for model in (teacher, student):
            model.restore(copy.deepcopy(model.capture()), host.arguments)
        student.training_setup(host.arguments)
        teacher.optimizer = None
        taught = host.store(teacher).logits.detach().clone()
        before = teacher._opacity.detach().clone()
        camera, pictures = host.camera(), []
        for iteration in (1, 2, 3):
            student.update_learning_rate(iteration)
            view = copy.deepcopy(camera)
            image = host.render(view, student)["render"]
            pictures.append(host.render(view, teacher)["render"].detach())
            (image - pictures[-1]).abs().mean().backward()
            student.optimizer.step()
            student.optimizer.zero_grad(set_to_none=True)
        assert torch.equal(host.store(teacher).logits, taught)
        assert torch.equal(teacher._opacity, before)
        assert torch.equal(pictures[0], pictures[2])
        assert (host.store(student).steps, host.store(teacher).steps) == (3, 2)
        assert not torch.equal(host.store(student).logits, taught)
        with host.paused():
            assert not torch.equal(host.render(camera, teacher)["render"], pictures[0])
        state = host.last_state
        assert state.store is host.store(student)
        assert len(state.stage._before) == 1  # copies of a camera are one view


def test_a_held_out_view_with_the_number_of_a_training_view_is_no_visit_of_it(mini):
    with joint(**of(mini)) as host:
        model, camera, held_out = host.model(COUNT), host.camera(), host.camera(side=0.6)
        held_out.uid = camera.uid
        host.step(model, camera, 1)
        before = host.finish()
        with torch.no_grad():
            host.render(held_out, model)
        assert host.finish() == before
        assert before.fragments_after > 0


def test_flags_of_distillation_are_left_out_of_what_resumes_it():
    shared = ["-s", "a", "-m", "b", "--eval", "--test_iterations", "-1"]
    own = ["--new_max_sh", "1", "--teacher_model", "t", "--enable_opacity", "--opacity_prune", "0"]
    words = [*shared, *own]
    script, arguments = LightGaussian().resumed_by(Path("x/distill_train.py"), words)
    assert script == Path("x/train_densify_prune.py")
    assert arguments == [*shared, "--sh_degree", "1"]
    for name in ("x/train_densify_prune.py", "x/prune_finetune.py"):
        assert LightGaussian().resumed_by(Path(name), words) == (Path(name), words)
