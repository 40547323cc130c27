"""An experiment, end to end on a tiny scene with few arms."""

from __future__ import annotations

import csv
import json
import shutil
from dataclasses import replace
from pathlib import Path

import pytest
import torch
from finetune import tiny
from lab import catalogue, running
from lab.catalogue import Arm, Experiment, Pruning
from lab.rules import alpha_cutoff, shrunk
from lab.tests.commands import run, run_json
from PIL import Image

from fragprune_plugins.learning.goals import Control, Portable, Pressure
from fragprune_plugins.learning.schedule import Settings


def few(settings):
    settings = replace(settings, goal=Pressure(1e-2))
    control = replace(settings, goal=Control())
    return Experiment(
        "rules",
        "What wins?",
        (
            Arm("control", "", control),
            Arm("learned", "", settings),
            Arm("alpha", "16/255", settings, alpha_cutoff(16)),
        ),
    )


@pytest.fixture
def trained(monkeypatch):
    """Settings and rules that trainings were asked for."""
    calls = []
    finetune, finetune_by = running.finetune, running.finetune_by

    def learning(model, dataset, settings, **options):
        calls.append((settings, None))
        return finetune(model, dataset, settings, **options)

    def following(rule, model, dataset, settings, **options):
        calls.append((settings, rule))
        return finetune_by(rule, model, dataset, settings, **options)

    monkeypatch.setattr(running, "finetune", learning)
    monkeypatch.setattr(running, "finetune_by", following)
    monkeypatch.setitem(catalogue.EXPERIMENTS, "rules", few)
    monkeypatch.setattr(running, "ENLARGED", 2)
    return calls


@pytest.fixture
def words(tmp_path):
    data, model, _ = tiny.scene(tmp_path)
    return [
        "rules",
        model,
        "--data",
        data,
        "--out",
        tmp_path / "out",
        "--iters",
        3,
        "--train",
        "opacity",
    ]


def test_writes_table_sheet_plot_and_configuration(words, trained, tmp_path):
    result = run(*words, "--seeds", "0,1")
    assert result.exit_code == 0, result.stderr
    assert "rules" in result.stderr  # the bar
    assert len(trained) == 6
    out = tmp_path / "out"
    page = (out / "rules.md").read_text()
    for label in ("as it came", "control", "learned", "alpha 16/255", "area/px", "±", "What wins?"):
        assert label in page
    with open(out / "rules.csv") as file:
        sheet = list(csv.DictReader(file))
    assert [row["label"] for row in sheet] == ["as it came", "control", "learned", "alpha 16/255"]
    assert float(sheet[3]["fragments_per_pixel"]) < float(sheet[1]["fragments_per_pixel"])
    with Image.open(out / "rules.png") as picture:
        assert len(picture.convert("RGB").getcolors(1 << 24)) > 10
    asked = json.loads((out / "rules.json").read_text())
    assert asked["seeds"] == [0, 1]
    assert asked["arms"]["alpha 16/255"]["rule"] == "alpha_cutoff(16)"
    assert asked["arms"]["learned"]["settings"]["goal"] == "pressure=0.01"
    assert {row["iterations"] for row in sheet} == {"0", "3"}
    assert all(0 < float(row["psnr_training"]) < 100 for row in sheet)
    assert {"version", "model", "machine", "photographs", "engine", "threads"} <= asked.keys()


@pytest.mark.parametrize("name", ["rules.md", "rules.csv", "rules.png"])
def test_a_file_that_no_experiment_wrote_stays(words, trained, tmp_path, name):
    mine = tmp_path / "out" / name
    mine.parent.mkdir()
    mine.write_text("mine")
    result = run(*words)
    assert result.exit_code == 1
    assert name in result.stderr
    assert mine.read_text() == "mine"
    assert not trained


def test_the_gain_over_the_control_is_the_difference_of_the_rows(words, trained):
    report = run_json(*words, "--seeds", "0,1")
    came, control, *others = report["rows"]
    assert came["against_control"] is None
    assert control["against_control"] is None
    assert came["speedup"] == 1
    assert came["train_seconds"] is None
    for row in others:
        assert row["against_control"] == pytest.approx(row["psnr"] - control["psnr"], abs=1e-9)
        assert row["frame_ms_enlarged"] > 0


def test_goes_on_without_training_again(words, trained, tmp_path):
    first = run_json(*words)
    assert len(trained) == 3
    assert run_json(*words) == first
    assert len(trained) == 3
    (lost,) = (tmp_path / "out" / "arms").glob("*learned*")
    lost.unlink()
    run_json(*words)
    assert len(trained) == 4
    settings, rule = trained[-1]
    assert settings.goal == Pressure(1e-2)
    assert rule is None


@pytest.mark.parametrize(
    ("more", "said"),
    [
        (["--iters", 4], "arms.control.settings.iterations was 3 and is 4"),
        (["--seeds", "0,1"], "seeds was [0] and is [0, 1]"),
        (["--resolution", 2], "photographs.resolution.divide was 1 and is 2"),
    ],
)
def test_another_configuration_is_refused(words, trained, more, said):
    run_json(*words)
    result = run(*words, *more)
    assert result.exit_code == 1
    assert said in result.stderr
    assert len(trained) == 3


def test_a_changed_list_of_arms_is_refused(words, trained, monkeypatch):
    run_json(*words)
    monkeypatch.setitem(
        catalogue.EXPERIMENTS, "rules", lambda asked: replace(few(asked), arms=few(asked).arms[:2])
    )
    result = run(*words)
    assert result.exit_code == 1
    assert "arms.alpha 16/255 is missing" in result.stderr
    monkeypatch.setitem(
        catalogue.EXPERIMENTS,
        "rules",
        lambda asked: replace(few(asked), arms=few(asked).arms[::-1]),
    )
    assert "the same arms in another order" in run(*words).stderr


def test_changed_photographs_are_refused(words, trained):
    run_json(*words)
    data = words[3]
    shutil.copy(data / "images" / "view01.png", data / "images" / "view02.png")
    result = run(*words)
    assert result.exit_code == 1
    assert "photographs.sha256 was" in result.stderr


def test_results_of_another_configuration_are_not_taken_over(words, trained, tmp_path):
    run_json(*words)
    for file in (tmp_path / "out").glob("rules.*"):
        file.unlink()
    result = run(*words, "--train", "appearance")
    assert result.exit_code == 1
    assert "a result of another configuration" in result.stderr


def test_ctrl_c_keeps_finished_arms(words, trained, monkeypatch, tmp_path):
    counted = running.finetune

    def interrupted(*arguments, **options):
        result = counted(*arguments, **options)
        return replace(result, interrupted=len(trained) == 2)

    monkeypatch.setattr(running, "finetune", interrupted)
    result = run(*words)
    assert result.exit_code == 130
    assert "Repeat the command" in result.stderr
    assert len(list((tmp_path / "out" / "arms").iterdir())) == 1
    run_json(*words)
    assert len(trained) == 2 + 2


@pytest.mark.parametrize(
    ("words", "said"),
    [
        (["portable", "x.ply", "--train", "opacity"], "only shapes that move"),
        (["rules", "x.ply", "--iters", 3, "--scale", 2], "--iters with --scale"),
        (["rules", "x.ply", "--seeds", "a"], "not a list such as 0,1,2"),
        (["rulers", "x.ply"], "rulers"),
    ],
)
def test_contradictions_are_usage_errors(words, said, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    Path("x.ply").touch()
    result = run(*words, "--data", tmp_path, "--out", tmp_path / "out")
    assert result.exit_code == 2
    assert said in result.stderr


def test_the_configuration_tells_models_apart(words, trained, tmp_path):
    run_json(*words)
    model = words[1]
    other = tmp_path / "other"
    other.mkdir()
    shutil.copy(model, other / model.name)
    words[1] = other / model.name
    run_json(*words)  # the same model elsewhere
    assert len(trained) == 3
    tiny.write_ply(words[1], tiny.random_model(seed=5))
    result = run(*words)
    assert result.exit_code == 1
    assert "model.sha256 was" in result.stderr


def test_an_arm_truncates_from_where_it_opens(words, trained, monkeypatch):
    """Until then it trains as the control does, to the bit."""
    learned = Settings(iterations=3, train="opacity", goal=Pressure(1e-2), stop=None)
    arms = (
        Arm("control", "", replace(learned, goal=Control())),
        *(Arm("learned", str(opens), learned, warmup=opens) for opens in (0, 3)),
    )
    experiment = Experiment("rules", "When?", arms, over="iterations")
    monkeypatch.setitem(catalogue.EXPERIMENTS, "rules", lambda asked: experiment)
    _, control, early, never = run_json(*words)["rows"]
    for key in ("fragments_per_pixel", "psnr", "psnr_training"):
        assert never[key] == control[key]
    assert early["fragments_per_pixel"] < control["fragments_per_pixel"]


def test_prunes_before_training_and_scores_once(words, trained, monkeypatch):
    scored = []

    def by_row(model, views, engine):
        scored.append(len(list(views)))
        return torch.arange(len(model))

    def pruned(settings):
        control = few(settings).arms[0].settings
        prunings = [Pruning("opacity", keep) for keep in (0.5, 0.1)]
        arms = [Arm("opacity", f"{each.keep:.0%}", control, pruning=each) for each in prunings]
        return Experiment("rules", "What wins?", (Arm("control", "", control), *arms))

    monkeypatch.setitem(catalogue.EXPERIMENTS, "rules", pruned)
    monkeypatch.setitem(running.SCORES, "opacity", by_row)
    report = run_json(*words)
    _, control, half, tenth = report["rows"]
    assert [row["gaussians"] for row in (control, half, tenth)] == [60, 30, 6]
    assert control["against_control"] is None
    assert tenth["against_control"] == pytest.approx(tenth["psnr"] - control["psnr"])
    assert scored == [7]  # the training views, once for both arms
    arms = report["configuration"]["arms"]
    assert arms["opacity 50%"]["pruning"] == {"score": "opacity", "keep": 0.5}
    assert "pruning" not in arms["control"]


def changed(settings):
    settings = replace(settings, train="all", goal=Portable(1e-2))
    control = replace(settings, goal=Control())
    arms = (
        Arm("control", "", control),
        Arm("portable", "", settings),
        Arm("shrunk", "0.5", control, start=shrunk(0.5)),
    )
    return Experiment("rules", "What is light?", arms, over="area")


def test_an_arm_may_change_the_model_before_it_trains(words, trained, monkeypatch, tmp_path):
    monkeypatch.setitem(catalogue.EXPERIMENTS, "rules", changed)
    report = run_json(*words)
    came, control, portable, small = report["rows"]
    assert small["area_per_pixel"] < 0.6 * came["area_per_pixel"]
    assert portable["area_per_pixel"] < control["area_per_pixel"]
    assert small["against_control"] == pytest.approx(small["psnr"] - control["psnr"], abs=1e-9)
    asked = json.loads((tmp_path / "out" / "rules.json").read_text())
    assert asked["arms"]["shrunk 0.5"]["start"] == "shrunk(0.5)"
    parts = [json.loads(path.read_text()) for path in (tmp_path / "out" / "arms").iterdir()]
    assert len({part["before"]["area_per_pixel"] for part in parts}) == 1, "as it came, for all"


def test_other_defaults_of_the_pressure_are_another_configuration(words, trained, monkeypatch):
    """They are no settings, and a version under development has many of them."""
    from fragprune_plugins.learning import schedule

    def default(settings):
        settings = replace(settings, train="all")
        control = replace(settings, goal=Control())
        return Experiment("rules", "?", (Arm("control", "", control), Arm("learned", "", settings)))

    monkeypatch.setitem(catalogue.EXPERIMENTS, "rules", default)
    run_json(*words)
    monkeypatch.setattr(schedule, "_ELASTICITY_OF_ALL", 0.7)
    result = run(*words)
    assert result.exit_code == 1
    assert "arms.learned.schedule.pressure.elasticity was 0.2 and is 0.7" in result.stderr
