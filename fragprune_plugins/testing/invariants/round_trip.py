"""Invariant 5: saved models and checkpoints are loaded, bit for bit."""

from __future__ import annotations

from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import torch

from fragprune_plugins.errors import SidecarError
from fragprune_plugins.files import sidecar
from fragprune_plugins.hosts.seams import Role
from fragprune_plugins.testing.host import Running, alone, joint, running, tensors
from fragprune_plugins.testing.invariants.case import Case, require


def model_file(case: Case) -> None:
    """A saved model is loaded with its thresholds, and the host's file stays the host's."""
    case.expect("model file", Role.SAVE)
    with TemporaryDirectory() as folder:
        _through_a_model_file(case, Path(folder) / "point_cloud.ply")


def checkpoint(case: Case) -> None:
    """A checkpoint resumes with its thresholds, and the host alone can resume it too."""
    case.expect("checkpoint", Role.CAPTURE, Role.RESTORE)
    with TemporaryDirectory() as folder:
        _through_a_checkpoint(case, Path(folder) / "chkpnt3.pth")
        _out_of_stage_two(case, Path(folder) / "chkpnt3.pth")


def _trained(host: Running) -> Any:
    model, camera = host.model(20), host.camera()
    for iteration in (1, 2, 3):
        host.step(model, camera, iteration)
    return model


def _require_same(state: dict[str, Any], other: dict[str, Any], what: str) -> None:
    for key, value in state.items():
        same = torch.equal(value, other[key]) if torch.is_tensor(value) else value == other[key]
        require(same, f"{key} {what} differ from those saved")


def _through_a_model_file(case: Case, path: Path) -> None:
    with joint(**case.options()) as host:
        model = _trained(host)
        host.driver.save(model, path)
        state = host.store(model).state_dict()
        with torch.no_grad():
            picture = host.render(host.camera(), model)["render"]
        bands = host.driver.bands(model)
        ours = path.read_bytes()
        host.deactivate()
        host.driver.save(model, path)
        require(path.read_bytes() == ours, "the host's own file is not what the host writes alone")
        stale = sidecar.path_beside(path)
        require(stale.exists(), "no sidecar was written")
    with running(learn=False, **case.options()) as host:  # as a host's render script does
        loaded = host.model(5, setup=False)
        host.driver.load(loaded, path)
        store = host.store(loaded)
        require(store is not None, "a loaded model has no thresholds")
        _require_same(state, store.state_dict(), "of a loaded model")
        host.driver.use_bands(loaded, bands)  # hosts load with all; training was not so far
        with torch.no_grad():
            again = host.render(host.camera(), loaded)["render"]
        require(torch.equal(again, picture), "a loaded model's picture is not the saved one's")
        other = host.model(20, seed=4, setup=False)
        host.driver.save(other, path)  # trained again, without us
        try:
            host.driver.load(host.model(5, setup=False), path)
        except SidecarError:
            return
        raise AssertionError("the sidecar of another file was taken")


def _through_a_checkpoint(case: Case, path: Path) -> None:
    with joint(**case.options()) as host:
        model = _trained(host)
        state, parameters = host.store(model).state_dict(), tensors(host.driver, model)
        torch.save((host.driver.capture(model), 3), path)
    with joint(**case.options()) as host:
        model = _resumed(host, path)
        _require_same(state, host.store(model).state_dict(), "of a restored model")
        _require_same(parameters, tensors(host.driver, model), "of a restored model")
        host.step(model, host.camera(), 4)
    with alone(**case.options()) as host:
        model = _resumed(host, path)  # the host alone reads it too
        _require_same(parameters, tensors(host.driver, model), "restored without us")


def _out_of_stage_two(case: Case, path: Path) -> None:
    """Resumed without learning, stage 2's checkpoint trains the same parameters as the host's."""
    moved, rates = [], []
    for learn in (False, True):
        with running(learn=learn, **case.options()) as host:
            torch.save((host.driver.capture(_trained(host)), 3), path)
        with alone(**case.options()) as host:
            model = _resumed(host, path)
            before = tensors(host.driver, model)
            for iteration in (4, 5, 6):
                host.step(model, host.camera(), iteration)
            after = tensors(host.driver, model)
            moved.append({name for name in before if not torch.equal(before[name], after[name])})
        with running(learn=False, **case.options()) as host:
            model = _resumed(host, path)
            rates.append({name: group["lr"] for name, group in host.session.groups(model)})
    require(moved[1] == moved[0], f"resumed, {sorted(moved[1])} move; expected {sorted(moved[0])}")
    require(rates[1] == rates[0], f"resumed, rates are {rates[1]}; expected {rates[0]}")


def _resumed(host: Running, path: Path) -> Any:
    model = host.model(5)
    captured, _ = torch.load(path, weights_only=False)
    host.driver.restore(model, captured, host.arguments)
    return model
