"""Invariant 5: what is saved is loaded, bit for bit, and the host's files stay the host's."""

from __future__ import annotations

import pytest
import torch
from miniature import joint, running, tensors

from fragprune_plugins import sidecar
from fragprune_plugins.errors import SidecarError


def trained(host, count=20):
    model, camera = host.model(count), host.camera()
    for iteration in (1, 2, 3):
        host.step(model, camera, iteration)
    return model


def same(one, other):
    return all(
        torch.equal(value, other[key]) if torch.is_tensor(value) else value == other[key]
        for key, value in one.items()
    )


def test_a_saved_model_is_loaded_with_its_thresholds(tmp_path):
    path = tmp_path / "point_cloud.ply"
    with joint() as host:
        model = trained(host)
        model.save_ply(str(path))
        state, picture = host.store(model).state_dict(), host.render(host.camera(), model)
    with running(learn=False) as host:  # as render.py does
        loaded = host.model(5, setup=False)
        loaded.load_ply(str(path))
        assert same(state, host.store(loaded).state_dict())
        loaded.active_sh_degree = 0  # load_ply uses every band; training had not come so far
        again = host.render(host.camera(), loaded)
        assert torch.equal(again["render"], picture["render"].detach())
        assert torch.equal(again["radii"], picture["radii"])


def test_the_hosts_files_are_what_the_host_alone_writes(tmp_path):
    with joint() as host:
        model = trained(host)
        model.save_ply(str(tmp_path / "ours.ply"))
        capture = model.capture()
        host.deactivate()
        model.save_ply(str(tmp_path / "host.ply"))
        alone = model.capture()
    assert (tmp_path / "ours.ply").read_bytes() == (tmp_path / "host.ply").read_bytes()
    assert len(capture) == len(alone) == 12
    extra = {key for part in capture if isinstance(part, dict) for key in part}
    assert extra - {key for part in alone if isinstance(part, dict) for key in part} == {
        "fragprune"
    }


def test_a_checkpoint_carries_thresholds_and_moments_through_a_file(tmp_path):
    path = tmp_path / "chkpnt3.pth"
    with joint() as host:
        model = trained(host)
        state, parameters = host.store(model).state_dict(), tensors(model)
        torch.save((model.capture(), 3), path)
    with joint() as host:
        model = host.model(5)
        capture, iteration = torch.load(path, weights_only=False)
        model.restore(capture, host.arguments)
        assert iteration == 3
        assert same(state, host.store(model).state_dict())
        assert same(parameters, tensors(model))
        camera = host.camera()
        host.step(model, camera, 4)
        resumed = host.store(model).logits.detach().clone()
    with joint() as host:
        model, camera = host.model(20), host.camera()
        for iteration in (1, 2, 3, 4):
            host.step(model, camera, iteration)
        # Rows, moments and counters all came along; the schedule alone counts anew.
        assert len(resumed) == len(host.store(model))


def test_a_checkpoint_with_thresholds_resumes_without_us(tmp_path):
    path = tmp_path / "chkpnt3.pth"
    with joint() as host:
        model = trained(host)
        parameters = tensors(model)
        torch.save((model.capture(), 3), path)
    with running(active=False) as host:
        host.session._install_stand_ins()  # the host's compiled packages, no seam wrapped
        model = host.model(5)
        model.restore(torch.load(path, weights_only=False)[0], host.arguments)
        assert same(parameters, tensors(model))


def test_a_sidecar_of_another_file_is_refused_before_anything_is_drawn(tmp_path):
    path = tmp_path / "point_cloud.ply"
    with joint() as host:
        trained(host).save_ply(str(path))
    kept = sidecar.path_beside(path).read_bytes()
    with running(learn=False) as host:
        host.model(20, seed=4, setup=False).save_ply(str(path))  # trained again, without us
        assert sidecar.path_beside(path).read_bytes() == kept
        with pytest.raises(SidecarError, match="thresholds of another model"):
            host.model(5, setup=False).load_ply(str(path))


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
