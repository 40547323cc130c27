"""Thresholds, an engine, a schedule of a plugin: alike in every command and function that draws."""

from dataclasses import replace

import pytest
import torch
from cli.commands import DRAWING, drawing, run, run_json
from finetune import tiny
from finetune.conftest import dataset as dataset  # a fixture, as the others are
from finetune.conftest import model as model
from finetune.conftest import truth as truth

import fragprune_plugins
from fragprune_plugins import RasterInputs, Schedule, Settings, ThresholdStore, finetune
from fragprune_plugins.engines import create_engine
from fragprune_plugins.files import sidecar
from fragprune_plugins.plugins.hookspecs import hookimpl

CUT_ALL = 0.999999
HOST = fragprune_plugins.__path__[0] + "/workbench/demo/host/train.py"


class Fixed:
    """One threshold for all, whatever was learned."""

    @hookimpl
    def fragprune_truncate(self, inputs, store):
        return torch.full((len(store),), CUT_ALL)


class Mine:
    """An engine with a name of its own, and how often it drew."""

    name = "mine"

    def __init__(self):
        self.frames = 0

    @hookimpl
    def fragprune_create_engine(self, name, device):
        return self if name == "mine" else None

    def rasterize(self, inputs, thresholds):
        self.frames += 1
        return create_engine("auto").rasterize(inputs, thresholds)


class Never:
    """Thresholds stay where they open."""

    @hookimpl
    def fragprune_create_schedule(self, settings):
        class Held(Schedule):
            def at(self, step):
                return replace(super().at(step), learn=False)

        return Held(settings)


@pytest.fixture
def scene(tmp_path):
    """Photographs, a model whose thresholds lie beside it, a cameras file, a folder to write to."""
    data, path, model = tiny.scene(tmp_path)
    store = ThresholdStore(len(model))
    with torch.no_grad():
        store.logits.copy_(torch.logit(torch.full((len(model),), 0.3)))
    sidecar.save(path, store)
    cameras = tiny.write_path(tmp_path / "path.json", ["a"], 32, 32)
    return data, path, cameras, tmp_path / "out"


def drawn(report):
    """Fragments per pixel of what a command drew with the model's thresholds."""
    if "results" in report:
        return [row["fragments_per_pixel"] for row in report["results"] if row["truncated"]]
    parts = [report[key] for key in ("before", "after", "a", "b") if key in report] or [report]
    return [part["fragments_per_pixel"] for part in parts]


@pytest.mark.parametrize("command", DRAWING)
def test_every_command_draws_with_a_plugins_engine_and_thresholds(command, scene, plug):
    assert min(drawn(run_json(command, *drawing(*scene)[command]))) > 0
    mine = Mine()
    plug(mine, "engine")
    plug(Fixed(), "thresholds")
    report = run_json(command, *drawing(*scene)[command], "--engine", "mine")
    assert max(drawn(report)) == 0
    row = report["results"][0] if "results" in report else report
    row = row["columns"]["truncated"] if "columns" in row else row
    assert row["engine"] == "mine"
    assert mine.frames > 0


def test_report_draws_with_a_plugins_engine_and_thresholds(scene, plug):
    data, _, _, out = scene
    run_json("finetune", *drawing(*scene)["finetune"])
    mine = Mine()
    plug(mine)
    run_json("report", out, "--data", data, "--engine", "mine")
    assert mine.frames > 0


@pytest.mark.parametrize("command", [*DRAWING, "run", "demo"])
def test_an_unknown_engine_is_refused_with_those_that_are_known(command, scene, plug, tmp_path):
    plug(Mine(), "my_plugin")
    others = {
        "run": ("--", "python", HOST, "-s", "x", "-m", tmp_path / "m"),
        "demo": ("--out", tmp_path / "demo"),
    }
    words = (drawing(*scene) | others)[command]
    result = run(command, "--engine", "mime", *words)
    assert result.exit_code == 1
    assert result.stderr.count("[engine] engine: 'mime'; expected one of auto, reference, cpu") == 1
    assert "plugins asked: my_plugin" in result.stderr
    assert not (tmp_path / "m").exists()
    assert not (tmp_path / "demo").exists()


def test_finetune_learns_by_a_plugins_schedule(model, dataset, plug):
    settings = Settings(iterations=5, stop=None)
    learned = finetune(model, dataset, settings)
    plug(Never())
    result = finetune(model, dataset, settings)
    assert learned.model.thresholds is not None
    assert result.model.thresholds is None
    given = finetune(model, dataset, settings, schedule=Schedule(settings)).model  # which wins
    assert torch.equal(given.thresholds.logits, learned.model.thresholds.logits)


def test_thresholds_that_are_passed_win_over_a_plugins(model, plug):
    plug(Fixed())
    inputs = RasterInputs(tiny.cameras()[0].view(), model.splats())
    store = ThresholdStore(len(model))
    neutral = fragprune_plugins.rasterize(inputs, store)
    assert torch.equal(neutral.image, fragprune_plugins.rasterize(inputs).image)
    store.open(torch.sigmoid(model.opacity))
    assert float(fragprune_plugins.rasterize(inputs, store).fragments_per_pixel.detach()) == 0
    passed = fragprune_plugins.rasterize(inputs, store.values)
    assert float(passed.fragments_per_pixel.detach()) > 0


def test_an_engine_is_created_once_for_a_name_and_a_device(model, plug):
    made = []

    class Counting:
        @hookimpl
        def fragprune_create_engine(self, name, device):
            made.append((name, str(device)))

    plug(Counting())
    inputs = RasterInputs(tiny.cameras()[0].view(), model.splats())
    for _ in range(3):
        fragprune_plugins.rasterize(inputs)
    assert made == [("auto", "cpu")]
