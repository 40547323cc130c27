"""Invariants 3, 5 and 6: thresholds keep to their rows and files, and stage 2 to what it names."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from functools import partial
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import torch
from hypothesis import HealthCheck, Phase, given, settings
from hypothesis import strategies as st
from torch import Tensor

from fragprune_plugins.errors import AlignmentError, SidecarError
from fragprune_plugins.files import sidecar
from fragprune_plugins.hosts.seams import Role
from fragprune_plugins.learning.schedule import Settings
from fragprune_plugins.testing.host import (
    FAINT,
    Chance,
    Host,
    Running,
    alone,
    expect_ancestors,
    joint,
    label,
    running,
    tensors,
)
from fragprune_plugins.testing.invariants.case import COUNT, Case, FixedThresholds, refused, require

MOST = 400  # rows after which a sequence of actions ends


def alignment(case: Case) -> None:
    """After any sequence of actions each row has the threshold of the row it descends from."""
    names = sorted(case.driver.actions())
    chances = st.builds(Chance, st.integers(0, 99), st.floats(0.05, 0.6))
    sequences = st.lists(st.tuples(st.sampled_from(names), chances), min_size=1, max_size=7)

    @settings(
        max_examples=case.examples,
        deadline=None,
        derandomize=True,
        database=None,
        suppress_health_check=list(HealthCheck),
        phases=[Phase.generate, Phase.shrink],
    )
    @given(sequences)
    def follow_any(sequence: list[tuple[str, Chance]]) -> None:
        with joint(**case.options()) as host:  # of its own: it may end in the midst of an action
            _follow(host, sequence)

    follow_any()
    with joint(**case.options()) as host:
        for name in names:  # each at least once, first and alone
            for seed in (1, 2):
                _follow(host, [(name, Chance(seed, 0.4))])
    _rows_behind_the_store(case)


def _follow(host: Running, sequence: list[tuple[str, Chance]]) -> None:
    model, camera = host.model(COUNT), host.camera(16, 12)
    host.step(model, camera, 1)  # so that the host's optimizer has moments to move
    label(host, model)
    actions = host.driver.actions()
    for name, chance in sequence:
        chance = replace(chance)  # a fresh generator, also when Hypothesis tries again
        torch.manual_seed(chance.seed)  # hosts draw parents from the global stream
        actions[name](model, host.arguments, chance)
        expect_ancestors(host, model)
        if not 0 < len(host.adapter.means(model)) < MOST:
            return
    require(host.render(camera, model)["render"].isfinite().all(), "pixels not finite")


def _rows_behind_the_store(case: Case) -> None:
    """A store that lost rows is refused at every use, with both counts."""
    with joint(**case.options()) as host, TemporaryDirectory() as folder:
        model, camera = host.model(COUNT), host.camera(16, 12)
        host.step(model, camera, 1)
        host.store(model).keep(torch.arange(COUNT) < COUNT - 6)
        uses: dict[str, Callable[[], Any]] = {"render": lambda: host.render(camera, model)}
        if case.has(Role.SAVE):
            uses["save"] = lambda: host.driver.save(model, Path(folder) / "point_cloud.ply")
        if case.has(Role.CAPTURE):
            uses["capture"] = lambda: host.driver.capture(model)
        for name, use in uses.items():
            went_on = f"{name} went on with {COUNT - 6} thresholds for {COUNT}"
            error = refused(AlignmentError, use, went_on)
            counts = (str(COUNT) in error.found, str(COUNT - 6) in error.expected)
            require(all(counts), f"{name}: the error names other counts: {error}")


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
        written = path.with_name("other.ply")
        host.driver.save(other, written)
        written.replace(path)  # trained again, without us
        load = partial(host.driver.load, host.model(5, setup=False), path)
        refused(SidecarError, load, "the sidecar of another file was taken")


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


ASKED = {"opacity": {"opacities"}, "appearance": {"opacities", "sh", "colors"}}
"""Fields of the Gaussians whose gradients an engine works out; the others cost nothing."""


def freeze(case: Case) -> None:
    """In stage 2 only the parameters of ``--train`` and the thresholds change, to the bit."""
    driver = case.driver
    moving: dict[str, frozenset[str] | None] = {
        "opacity": driver.opacity,
        "appearance": driver.opacity | driver.colour,
        "all": None,
    }
    for train, named in moving.items():
        of = f"--train {train}:"
        settings, drawn = Settings(iterations=9, train=train), FixedThresholds()  # type: ignore[arg-type]
        with running(settings, from_step=2, plugins=[drawn], **case.options()) as host:
            model, camera = host.model(20), host.camera()
            driver.use_bands(model, 1)  # every band takes part
            for iteration in (1, 2):
                host.step(model, camera, iteration)
            asking = _asking(driver, model)
            before, thresholds = tensors(driver, model), host.store(model).logits.detach().clone()
            bands = driver.bands(model)
            for iteration in (3, 4, 5, 6):
                host.step(model, camera, iteration)
                for name in driver.routine:
                    held = tensors(driver, model)
                    driver.actions()[name](model, host.arguments, Chance(iteration, 0.4))
                    _expect_held(held, tensors(driver, model), f"{of} {name}")
            after = tensors(driver, model)
            require(driver.bands(model) == bands, f"{of} a band was added")
            moved = {name for name in before if not torch.equal(before[name], after[name])}
            expected = set(before) if named is None else named & before.keys()
            require(moved == expected, f"{of} moved {sorted(moved)}; expected {sorted(expected)}")
            left = f"{of} left other parameters asking for a gradient than it found"
            require(_asking(driver, model) == asking, left)
            asked = f"{of} the engine was asked for gradients of {sorted(drawn.asking)}"
            require(named is None or drawn.asking <= ASKED[train], asked)
            learned = host.store(model)
            require(learned.steps == 4, f"{of} {learned.steps} threshold steps of 4")
            require(not torch.equal(learned.logits, thresholds), "thresholds stood still")


def _asking(driver: Host, model: Any) -> set[str]:
    """The parameters that require a gradient."""
    return {name for name, value in driver.parameters(model).items() if value.requires_grad}


def _expect_held(before: dict[str, Tensor], after: dict[str, Tensor], what: str) -> None:
    """Require that a routine of the host changed nothing; the action may make rows faint."""
    for name, value in before.items():
        same_rows = value.shape == after[name].shape
        require(same_rows, f"{what} made {len(after[name])} rows of {len(value)}")
        held = (after[name] == value) | (after[name] == FAINT)
        require(held.all(), f"{what} changed {name}")
