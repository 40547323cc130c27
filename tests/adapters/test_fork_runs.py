"""Whole runs of a fork of the demo's host, which no adapter names."""

from dataclasses import replace

import pytest
import torch
from miniatures import runs
from miniatures.changed import ForkHost
from miniatures.runs import FINETUNE, OPTIONS, check_stage_two, edit, frozen_differences

from fragprune_plugins.files import sidecar
from fragprune_plugins.files.ply import read_ply
from fragprune_plugins.injection.launch import run
from fragprune_plugins.learning.goals import Control

RATES = "        gaussians.update_learning_rate(iteration)\n"
STEP = "                gaussians.optimizer.step()\n"


@pytest.fixture
def fork(tmp_path):
    """The fork, with another name of a method."""
    root = tmp_path / "fork"
    ForkHost().write(root)
    train = root / "train_scene.py"
    for file in (root / "scene/gaussian_model.py", train):
        edit(file, "densify_and_prune", "renew")
    return root


def test_a_fork_that_sets_its_rates_last_is_trained_and_pruned(fork, photographs, tmp_path):
    edit(fork / "train_scene.py", RATES, "")
    edit(fork / "train_scene.py", STEP, STEP + RATES.replace("        ", " " * 16))
    words = runs.command(fork / "train_scene.py", photographs, tmp_path / "out", 12)
    summary = run(words, OPTIONS)
    check_stage_two(summary, "3dgs-fork")
    assert [each["step"] for each in summary.curves] == list(range(1, 9))


def test_a_fork_without_checkpoints_is_pruned_in_one_run(fork, photographs, tmp_path):
    edit(fork / "train_scene.py", "chkpnt", "state")
    words = runs.command(fork / "train_scene.py", photographs, tmp_path / "out", 12)
    summary = run([*words, "--save_iterations", "13"], OPTIONS)
    names = [each.parent.name for each in (summary.model_before, summary.model_after)]
    assert names == ["iteration_12", "iteration_21"]
    first = summary.model_before.parent.with_name("iteration_13") / "point_cloud.ply"
    check_stage_two(replace(summary, model_before=first), "3dgs-fork")
    assert [each["step"] for each in summary.curves] == list(range(1, 9))
    control = replace(FINETUNE, settings=replace(OPTIONS.settings, goal=Control()))
    again = run(words, control)  # it cannot resume either
    assert again.model_after.is_relative_to(tmp_path / "out/control")
    assert again.steps == 8


ENDED = ("--densify_until_iter", 8)
HELD = """

class _Held:
    def __set__(self, model, value):
        vars(model).setdefault("box", [None])[0] = value

    def __get__(self, model, kind=None):
        return self if model is None else model.box[0]


GaussianModel._opacity = _Held()
"""


def every_second(ply, photographs, drawing, settings):
    """A look at a model."""
    return replace(settings, dropout=0.25), torch.arange(len(read_ply(ply))) % 2 == 0


def test_in_one_run_a_fork_begins_stage_two_with_what_a_look_keeps(fork, photographs, tmp_path):
    edit(fork / "train_scene.py", "chkpnt", "state")
    words = runs.command(fork / "train_scene.py", photographs, tmp_path / "out", 12, *ENDED)
    summary = run([*words, "--save_iterations", "13"], replace(OPTIONS, look=every_second))
    first = summary.model_before.parent.with_name("iteration_13") / "point_cloud.ply"
    whole = len(read_ply(summary.model_before))
    assert len(read_ply(first)) == summary.gaussians == (whole + 1) // 2
    check_stage_two(replace(summary, model_before=first), "3dgs-fork")
    assert summary.settings["dropout"] == 0.25


def test_none_is_looked_at_whose_parameters_another_object_holds(
    fork, photographs, tmp_path, caplog
):
    """They would keep all their rows."""
    edit(fork / "train_scene.py", "chkpnt", "state")
    with (fork / "scene/gaussian_model.py").open("a") as source:
        source.write(HELD)
    words = runs.command(fork / "train_scene.py", photographs, tmp_path / "out", 12, *ENDED)
    summary = run(words, replace(OPTIONS, look=every_second))
    assert "another object holds what trains of its Gaussians" in caplog.text
    assert summary.gaussians == len(read_ply(summary.model_before))


def test_of_several_models_none_is_looked_at(fork, photographs, tmp_path, caplog):
    train = fork / "train_scene.py"
    edit(train, SCENE, f'{PAIR}{SCENE}    pair["second"].training_setup(opt)\n')
    words = runs.command(train, photographs, tmp_path / "out", 12, *ENDED)
    summary = run(words, replace(OPTIONS, look=every_second))
    assert "without a look at the model: several models train" in caplog.text
    assert summary.settings["dropout"] is None


SCENE = "    scene = Scene(dataset, gaussians)\n    gaussians.training_setup(opt)\n"
PAIR = """    pair = {"second": GaussianModel(dataset.sh_degree)}
    Scene(dataset, pair["second"])
"""
BACKWARD = "        loss.backward()\n"
BOTH = """        second = l1_loss(render(camera, pair["second"], pipe, bg)["render"], truth)
        for each in (loss, second):
            each.backward()
"""
SAVED = "                scene.save(iteration)\n"
FILE = 'f"{scene.model_path}/second/iteration_{iteration}/point_cloud.ply"'


def test_two_models_of_one_script_learn_each_its_own_thresholds(fork, photographs, tmp_path):
    train = fork / "train_scene.py"
    edit(train, SCENE, f'{PAIR}{SCENE}    pair["second"].training_setup(opt)\n')
    edit(train, BACKWARD, BOTH)
    edit(train, SAVED, f'{SAVED}                pair["second"].save_ply({FILE})\n')
    edit(train, STEP, f'{STEP}                pair["second"].optimizer.step()\n')
    words = runs.command(train, photographs, tmp_path / "out", 12)
    summary = run([*words, "--save_iterations", "13"], OPTIONS)
    assert [each["step"] for each in summary.curves] == list(range(1, 9))
    stores = []
    for name in ("point_cloud", "second"):
        first, last = (tmp_path / f"out/{name}/iteration_{i}/point_cloud.ply" for i in (13, 21))
        stores.append(sidecar.load(last)[0])
        assert frozen_differences(first, last) == []
        assert not stores[-1].neutral
    assert not torch.equal(stores[0].logits, stores[1].logits)
    assert summary.gaussians == len(stores[0])
    assert summary.model_after.parent.parent.name == "point_cloud"
