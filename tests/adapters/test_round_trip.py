"""Invariant 5 where files meet other files; the round trips are tests/conformance's."""

from dataclasses import replace

import pytest
import torch
from miniatures.vanilla_3dgs import joint

from fragprune_plugins import Control, Pressure, Settings, ThresholdStore
from fragprune_plugins.files import sidecar
from fragprune_plugins.files.ply import read_ply
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
