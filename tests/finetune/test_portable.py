"""Portable: no thresholds, less area, and a file that every viewer draws as it is."""

from dataclasses import replace
from unittest.mock import Mock

import pytest
import torch
from cli.commands import fails, run_json, succeeds
from finetune import tiny

import fragprune_plugins as fp
from fragprune_plugins import Control, Portable, Schedule, Settings, ThresholdStore, finetune
from fragprune_plugins.adapting import RasterInputs, UsageError
from fragprune_plugins.engines import create_engine
from fragprune_plugins.files import sidecar
from fragprune_plugins.learning.pressure import OWN_AREA_PRESSURE, PORTABLE_ELASTICITY
from fragprune_plugins.workbench.figures.evaluate import covered_per_pixel
from fragprune_plugins.workbench.finetune import trial


@pytest.fixture
def scene(tmp_path):
    return tiny.scene(tmp_path)


def area(model, dataset):
    engine, splats = create_engine("auto"), model.splats()
    shots = dataset.test
    return sum(covered_per_pixel(engine, RasterInputs(s.view, splats)) for s in shots) / len(shots)


def test_surfels_are_no_goal_for_other_viewers(tmp_path):
    model = tiny.random_model()
    surfels = replace(model, scaling=model.scaling[:, :2].contiguous())
    dataset = tiny.dataset_in_memory(tmp_path, model)
    with pytest.raises(UsageError, match="a portable goal, and surfels"):
        finetune(surfels, dataset, Settings(iterations=1, goal=Portable()))


def test_without_pressure_it_is_the_control_to_the_bit(scene):
    data, _, model = scene
    dataset = fp.load_dataset(data)
    portable = finetune(model, dataset, Settings(iterations=8, goal=Portable(0.0)))
    control = finetune(model, dataset, Settings(iterations=8, goal=Control()))
    for name in ("xyz", "opacity", "scaling", "rotation", "f_dc"):
        assert torch.equal(getattr(portable.model, name), getattr(control.model, name))


def test_the_pressure_is_a_share_of_the_loss_per_area(scene):
    data, _, model = scene
    dataset = fp.load_dataset(data)
    result = finetune(model, dataset, Settings(iterations=3, goal=Portable()))
    assert result.curves[0].pressure == 0.0  # no loss is known before the first step
    covered = area(model, replace(dataset, test=dataset.train))
    expected = PORTABLE_ELASTICITY * result.curves[0].loss / covered
    assert result.curves[1].pressure == pytest.approx(expected, rel=0.5)  # one view, not the mean


def test_its_own_pictures_press_by_a_fixed_weight_from_the_first_step_on():
    settings = Settings(iterations=5000, itself=True, goal=Portable())
    assert settings.make_pressure().value == OWN_AREA_PRESSURE
    for itself in (True, False):
        schedule = Schedule(replace(settings, itself=itself))
        assert schedule.at(1).learn


def test_the_file_has_no_thresholds_and_takes_the_sidecar_of_an_earlier_one_away(scene, tmp_path):
    data, path, _ = scene
    out = tmp_path / "out.ply"
    before = sidecar.path_beside(out)
    arguments = ("finetune", path, "--data", data, "--out", out, "--iters", 20)
    fp.save(out, tiny.random_model())
    sidecar.save(out, ThresholdStore(60))
    result = succeeds(*arguments, "--portable", "--pressure", 1e-3)
    assert not before.exists()
    header = out.read_bytes().split(b"end_header")[0]
    assert b"fragprune" not in header
    assert b"trunc" not in header
    assert fp.load(out).thresholds is None  # nothing is missed
    assert "area per pixel" in result.stdout
    assert "which every viewer draws as it is" in result.stdout
    profile = run_json("profile", out, "--data", data)
    assert set(profile["columns"]) == {"untruncated"}


@pytest.mark.parametrize(
    ("more", "target"),
    [((), "photographs"), (("--keep", "visible"), "photographs"), (("--self",), "itself")],
)
def test_the_record_has_the_area_of_both(scene, tmp_path, more, target):
    data, path, model = scene
    out = tmp_path / "out.ply"
    words = ("--data", data, "--out", out, "--iters", 30, "--portable", "--pressure", 1e-2)
    report = run_json("finetune", path, *words, *more)
    dataset = fp.load_dataset(data)
    for side, splat in (("before", model), ("after", fp.load(out))):
        assert report[side]["area_per_pixel"] == pytest.approx(area(splat, dataset), rel=1e-6)
        assert report[side]["target"] == target
    assert report["after"]["area_per_pixel"] < report["before"]["area_per_pixel"]
    assert report["after"]["psnr"] > 20
    assert report["untruncated"] is None
    assert report["settings"]["goal"] == "portable=0.01"


def test_a_model_with_thresholds_is_refused(scene):
    data, _, model = scene
    model = tiny.cut(model, 0.1)
    with pytest.raises(UsageError, match="--no-truncation"):
        finetune(model, fp.load_dataset(data), Settings(goal=Portable()))


def test_the_command_refuses_one_before_it_tries_anything(scene, tmp_path, monkeypatch):
    data, _, model = scene
    fp.save(pruned := tmp_path / "pruned.ply", tiny.cut(model, 0.1))
    monkeypatch.setattr(trial, "forgotten", Mock(side_effect=AssertionError("tried")))
    words = ("finetune", pruned, "--data", data, "--out", tmp_path / "out.ply", "--portable")
    fails(*words, says="--no-truncation", code=2)
