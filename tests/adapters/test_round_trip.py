"""Invariant 5 where files meet other files; the round trips are tests/conformance's."""

from __future__ import annotations

import pytest
from miniatures.vanilla_3dgs import joint

from fragprune_plugins.errors import SidecarError
from fragprune_plugins.storage import sidecar
from fragprune_plugins.storage.ply import read_ply, write_ply


def trained(host, count=20):
    model, camera = host.model(count), host.camera()
    for iteration in (1, 2, 3):
        host.step(model, camera, iteration)
    return model


def test_a_neutral_model_saved_over_a_pruned_one_takes_the_old_sidecar_away(tmp_path):
    path = tmp_path / "point_cloud.ply"
    with joint() as host:
        trained(host).save_ply(str(path))
        assert sidecar.path_beside(path).exists()
        host.model(8).save_ply(str(path))
        assert not sidecar.path_beside(path).exists()


def test_a_model_loaded_without_a_sidecar_forgets_the_thresholds_it_had(tmp_path):
    with joint() as host:
        host.model(8).save_ply(str(tmp_path / "plain.ply"))
        model = trained(host)
        model.load_ply(str(tmp_path / "plain.ply"))
        assert host.store(model) is None
        assert host.render(host.camera(), model)["render"].isfinite().all()


def test_a_model_that_lost_its_sidecar_is_not_loaded_without_it(tmp_path):
    path = tmp_path / "pruned.ply"
    with joint() as host:
        trained(host).save_ply(str(path))
        write_ply(path, read_ply(path), marked=True)  # as finetune writes it
        sidecar.path_beside(path).unlink()
        with pytest.raises(SidecarError, match="saved with thresholds beside it"):
            host.model(5).load_ply(str(path))
