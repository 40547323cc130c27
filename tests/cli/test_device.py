"""Every command that draws works on the chosen device; one that is none stands for a GPU."""

import elsewhere
import pytest
import torch
from cli.commands import drawing, run_json, succeeds
from finetune import tiny

from fragprune_plugins import engines
from fragprune_plugins.adapting import Photographs, read_ply
from fragprune_plugins.plugins.loading import installed
from fragprune_plugins.workbench.commands import opening
from fragprune_plugins.workbench.commands.options import EngineOptions
from fragprune_plugins.workbench.figures.records import Recorded
from fragprune_plugins.workbench.models.formats.ply import write_ply
from fragprune_plugins.workbench.run.work import measure_models

pytestmark = pytest.mark.skipif(torch.__version__ < "2.5", reason="no such device can be made")


@pytest.fixture
def engine(monkeypatch, plug):
    """Draws what is elsewhere, where every command is sent."""
    made = elsewhere.Engine()
    plug(made)
    for module in (engines, opening):
        monkeypatch.setattr(module, "device_for", lambda wanted, engine="auto": elsewhere.DEVICE)
    with elsewhere.there():
        yield made


@pytest.fixture
def scene(tmp_path):
    data, path, model = tiny.scene(tmp_path)
    write_ply(path, tiny.cut(model, 0.3))
    cameras = tiny.write_path(tmp_path / "path.json", ["a", "b"])
    return data, path, cameras, tmp_path / "out"


@pytest.mark.parametrize("case", ["finetune", "render", "render cameras", "profile", "bench"])
def test_everything_is_on_the_device(case, scene, engine):
    _, path, cameras, out = scene
    words = drawing(*scene) | {
        "render cameras": (path, "--cameras", cameras, "--out", out),
        "bench": ("--size", "24x16", "--gaussians", 40),
    }
    report = run_json(case.split()[0], *words[case])
    row = report["results"][0] if "results" in report else report
    row = row if "device" in row else row["columns"]["truncated"]
    assert (row["engine"], row["device"]) == ("elsewhere", "meta")
    assert engine.frames > 0


def test_a_run_is_measured_there(scene, engine):
    data, path, _, _ = scene
    _, (before, after) = measure_models(
        Recorded(Photographs(data), (path, path), filtered=True), EngineOptions(device="cuda")
    )
    assert (before["device"], after["engine"]) == ("meta", "elsewhere")


def test_learning_there_and_here_is_the_same(scene, engine, monkeypatch):
    data, path, _, out = scene
    words = ("--data", data, "--iters", 10, "--pressure", 1e-3, "--threads", 1)
    succeeds("finetune", path, "--out", out / "there.ply", *words)
    drawn = engine.frames
    succeeds("report", out, "--data", data)
    assert engine.frames > drawn
    monkeypatch.undo()
    installed.cache_clear()
    succeeds("finetune", path, "--out", out / "here.ply", *words)
    falloffs = [read_ply(out / f"{name}.ply").falloff for name in ("there", "here")]
    torch.testing.assert_close(*falloffs)
    assert not torch.equal(read_ply(out / "there.ply").opacity, read_ply(path).opacity)
