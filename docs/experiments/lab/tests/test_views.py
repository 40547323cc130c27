"""Experiments on the views of finished models: where fragments and where time go."""

from __future__ import annotations

from dataclasses import replace

import pytest
import torch
from cli.commands import run_json as fragprune
from finetune import tiny
from lab import stages
from lab.fragments import weigh
from lab.tests.commands import run, run_json

import fragprune_plugins as fp
from fragprune_plugins.engines import create_engine
from fragprune_plugins.learning.thresholds import ThresholdStore
from fragprune_plugins.types import RasterInputs


@pytest.fixture
def words(tmp_path):
    """A model, the same one truncated, and where experiments on them are to lie."""
    data, model, _ = tiny.scene(tmp_path)
    splat = fp.load(model)
    store = ThresholdStore.from_falloff(torch.full((len(splat),), 0.3))
    fp.save(tmp_path / "cut.ply", replace(splat, thresholds=store))
    return [model, tmp_path / "cut.ply", "--data", data, "--out", tmp_path / "out"]


@pytest.mark.parametrize("tau", [None, 0.3])
def test_weights_one_by_one_sum_to_what_is_drawn(tau):
    model = tiny.random_model()
    camera = tiny.cameras()[0]
    view = camera.view() if hasattr(camera, "view") else camera
    thresholds = None if tau is None else torch.full((len(model),), tau)
    inputs = RasterInputs(view, model.splats(), counts=True)
    drawn = create_engine("auto").rasterize(inputs, thresholds)
    weights = weigh(inputs, thresholds, 10**6)
    assert len(weights) == drawn.fragments.sum()
    assert 0 < weights.min() <= weights.max() <= 0.99
    torch.testing.assert_close(weights.sum(), drawn.alpha.sum(), rtol=1e-4, atol=0)
    assert 0 < len(weigh(inputs, thresholds, 2)) < len(weights)


def test_fragments_are_counted_alike_in_every_way(words):
    report = run_json("fragments", *words)
    for label, path in (("model", words[0]), ("cut", words[1])):
        figures = {row["figure"]: row[label] for row in report["rows"]}
        measured = fragprune("profile", path, *words[2:4])
        drawn = figures["fragments per pixel"]
        assert drawn == pytest.approx(measured["fragments_per_pixel"], rel=1e-5)
        for what in ("opacity", "radius"):
            parts = [v for k, v in figures.items() if k.startswith(f"fragments per pixel, {what}")]
            assert sum(parts) == pytest.approx(drawn)
        one, ten = (figures[f"share of the {share} with most fragments"] for share in ("1%", "10%"))
        assert 0.1 <= ten < 1
        assert 0.01 <= one <= ten
        faint = figures["share of fragments with a weight below 1/255"]
        assert 0 <= figures["their share of the weights"] < faint < 1


@pytest.mark.parametrize("name", ["fragments", "stages"])
def test_one_model_is_drawn_without_its_thresholds_too(words, name, monkeypatch):
    monkeypatch.setattr(stages, "SIZES", (16,))
    report = run_json(name, *words[1:])
    assert list(report["configuration"]["models"]) == ["cut"]
    assert report["configuration"]["models"]["cut"]["thresholds"]
    if name == "stages":
        drawn = {row["model"]: row["fragments_per_pixel"] for row in report["rows"]}
    else:
        (drawn,) = (row for row in report["rows"] if row["figure"] == "fragments per pixel")
    assert drawn["cut"] < drawn["cut, untruncated"]


def test_stages_make_up_the_frame(words, monkeypatch):
    monkeypatch.setattr(stages, "SIZES", (16, 32))
    report = run_json("stages", *words, "--repeats", 3, "--engine", "cpu")
    rows = report["rows"]
    assert {row["size"] for row in rows} == {"16x16", "32x32"}
    for row in rows:
        assert row["ms"] > 0
        assert row["ms_se"] >= 0
        if row["model"] == "model":
            assert row["faster"] == 1
    for size, model in {(row["size"], row["model"]) for row in rows}:
        *parts, whole = [row for row in rows if (row["size"], row["model"]) == (size, model)]
        assert whole["stage"] == "frame"
        assert whole["ms"] >= whole["ms_quickest"]
        assert sum(row["ms_quickest"] for row in parts) == pytest.approx(whole["ms_quickest"])
    names = [row["stage"] for row in rows if (row["size"], row["model"]) == ("16x16", "cut")]
    assert names == ["projection", "binning", "blend", "rest", "frame"]
    out = words[-1]
    assert run_json("stages", *words, "--repeats", 3, "--engine", "cpu") == report
    (first, _) = sorted((out / "arms").iterdir())
    first.unlink()
    assert run_json("stages", *words, "--repeats", 3, "--engine", "cpu") != report


def test_an_engine_without_a_clock_shows_frames_alone(words, monkeypatch):
    monkeypatch.setattr(stages, "SIZES", (16,))
    report = run_json("stages", *words, "--repeats", 2, "--engine", "reference")
    assert {row["stage"] for row in report["rows"]} == {"frame"}


@pytest.mark.parametrize("name", ["fragments", "stages"])
def test_a_model_is_needed(words, name):
    assert run(name, *words[2:]).exit_code == 2


def test_one_disturbed_round_does_not_widen_the_error():
    even = [1.0 + 0.01 * step for step in range(15)]
    quiet = stages._median("ms", even)
    disturbed = stages._median("ms", [*even[:-1], 1000.0])
    assert disturbed == quiet
    # of a median of normal values: 1.2533 standard deviations over the root of their number
    stream = torch.Generator().manual_seed(0)
    normal = stages._median("ms", torch.randn(20_001, generator=stream).tolist())
    assert normal["ms_se"] == pytest.approx(1.2533 / 20_001**0.5, rel=0.03)
