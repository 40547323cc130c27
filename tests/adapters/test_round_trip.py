"""Invariant 5 where files meet other files; the round trips are tests/conformance's."""

import copy
from dataclasses import replace

import pytest
import torch
from miniatures.vanilla_3dgs import joint

from fragprune_plugins import Control, Pressure, Settings, ThresholdStore
from fragprune_plugins.files import sidecar
from fragprune_plugins.files.ply import read_ply
from fragprune_plugins.hosts.adapter import CHECKPOINT_KEY, optimizer_state
from fragprune_plugins.workbench.models.formats.ply import write_ply


def trained(host, count=20):
    model, camera = host.model(count), host.camera()
    for iteration in (1, 2, 3):
        host.step(model, camera, iteration)
    return model


def recorded(monkeypatch, host):
    """The stops that views are drawn with from now on."""
    seen = []
    engine = type(host.session.engine(torch.device("cpu")))
    draw = engine.rasterize
    monkeypatch.setattr(
        engine,
        "rasterize",
        lambda self, each, *more: seen.append(each.stop) or draw(self, each, *more),
    )
    return seen


@pytest.mark.parametrize("truncate", [True, False], ids=["thresholds", "control"])
def test_a_stop_is_drawn_with_and_saved_and_drawn_with_again(tmp_path, monkeypatch, truncate):
    path, settings = (
        tmp_path / "stopped.ply",
        Settings(iterations=3, stop=0.3, goal=Pressure() if truncate else Control()),
    )
    with joint(settings) as host:
        seen = recorded(monkeypatch, host)
        model = trained(host)
        assert seen == [0.3, None, 0.3, 0.3]  # None counts the fragments before, at the first visit
        model.save_ply(str(path))
        before = host.render(host.camera(), model)["render"]
    assert sidecar.load(path)[0].stop == 0.3
    with joint(learn=False) as host:
        seen = recorded(monkeypatch, host)
        again = host.model(5)
        again.load_ply(str(path))
        assert torch.equal(host.render(host.camera(), again)["render"], before)
        assert seen == [0.3]


def test_an_exact_copy_of_a_model_is_saved_with_its_thresholds(tmp_path, caplog):
    path = tmp_path / "copy.ply"
    with joint() as host:
        model = trained(host)
        values = host.store(model).values.detach().clone()
        other = copy.deepcopy(model)
        other.save_ply(str(path))
        held = optimizer_state(other.capture(), "copy")[CHECKPOINT_KEY]
    assert torch.equal(sidecar.load(path, 20)[0].values, values)
    assert torch.equal(held["logits"], sidecar.load(path)[0].logits)
    assert caplog.messages == []


def test_a_copy_that_is_another_model_by_now_is_saved_loudly(tmp_path, caplog):
    """Which thresholds were the copy's is not known: those of the model have learned since."""
    path = tmp_path / "best.ply"
    with joint() as host:
        model = trained(host)
        best = copy.deepcopy(model)
        host.step(model, host.camera(), 4)
        best.save_ply(str(path))
        best.capture()
    assert not sidecar.find(path)
    said = "without cutoffs: no learning model has these Gaussians"
    places = [f"GaussianModel.{each}" for each in ("save_ply", "capture")]
    assert all(f"{at}: {said}" in m for at, m in zip(places, caplog.messages, strict=True))


def test_a_model_loaded_without_a_sidecar_forgets_the_thresholds_it_had(tmp_path):
    with joint() as host:
        host.model(8).save_ply(str(tmp_path / "plain.ply"))
        model = trained(host)
        model.load_ply(str(tmp_path / "plain.ply"))
        assert host.store(model) is None
        assert host.render(host.camera(), model)["render"].isfinite().all()


def test_a_host_loads_the_thresholds_of_a_file_with_a_column(tmp_path):
    path = tmp_path / "pruned.ply"
    with joint() as host:
        learned = trained(host)
        learned.save_ply(str(path))
        values = host.store(learned).values.detach()
        write_ply(path, replace(read_ply(path), thresholds=ThresholdStore.from_falloff(values)))
        sidecar.path_beside(path).unlink()
        model = host.model(5)
        model.load_ply(str(path))
        assert torch.equal(host.store(model).values, values)
