"""A session, from its activation to its summary, over the smallest host."""

from importlib import import_module
from pathlib import Path
from types import SimpleNamespace

import pytest
import torch
from miniatures.vanilla_3dgs import joint, running

from fragprune_plugins import Control, Portable, Pressure, Settings
from fragprune_plugins.errors import RanksError, UsageError
from fragprune_plugins.hosts.seams import Role, Seam, SeamCall
from fragprune_plugins.injection import ranks
from fragprune_plugins.injection.rasterizing import SCALER, on_metric
from fragprune_plugins.injection.session import active_session


def test_after_it_an_optimizer_has_no_hook_of_ours():
    with joint() as host:
        model = host.model()
        assert model.optimizer._optimizer_step_pre_hooks
        state = host.session.models[model]
        assert host.session.deactivate() == []
        assert (state.hooks, len(state.hooked)) == ([], 0)
        assert not model.optimizer._optimizer_step_pre_hooks
        assert not model.optimizer._optimizer_step_post_hooks


@pytest.mark.parametrize("learn", [True, False])
def test_only_a_session_that_learns_minds_how_many_processes_train(monkeypatch, learn):
    def refused():
        raise RanksError("here", "2 processes", "one", "Start one.")

    monkeypatch.setattr(ranks, "expect_one", refused)
    with running(active=False, learn=learn) as host:
        if learn:
            with pytest.raises(RanksError):
                host.session.activate()
        else:
            host.session.activate()
        assert (active_session() is host.session) is not learn


@pytest.mark.parametrize(
    ("steps", "viewed", "goal"),
    [(3, True, Pressure()), (0, False, Pressure()), (3, False, Control())],
)
def test_steps_are_no_fault_if_a_view_was_drawn_or_none_had_to_be(steps, viewed, goal):
    with running(Settings(iterations=5, goal=goal), learn=False) as host:
        host.session.expect_drawn()  # nothing learned yet
        host.session.last_state = SimpleNamespace(stage=SimpleNamespace(steps=steps, viewed=viewed))
        host.session.expect_drawn()


def test_what_was_learned_is_saved_at_the_iteration_that_the_host_reached(monkeypatch):
    saved = []

    def save(*words):
        saved.append(words)
        return Path("there")

    with joint(Settings(iterations=2)) as host:
        model, camera, session = host.model(), host.camera(), host.session
        for iteration in (1, 2):
            host.step(model, camera, iteration)
        monkeypatch.setattr(session.adapter, "save_model", save)
        monkeypatch.setattr(session, "output", None)
        assert session.save_learned() is None
        monkeypatch.setattr(session, "output", Path("out"))
        monkeypatch.setattr(session, "start", 20)
        assert session.save_learned() == Path("there")
        assert saved == [(model, Path("out"), 22)]
        for last in (None, lambda: None):  # or the host dropped it
            monkeypatch.setattr(session, "last", last)
            assert session.save_learned() is None


@pytest.mark.parametrize(
    ("neutral", "portable", "steps", "saves"),
    [
        (True, False, 2, False),
        (True, True, 2, True),
        (True, True, 0, False),
        (False, False, 0, True),
    ],
)
def test_a_model_is_saved_only_if_it_learned(monkeypatch, neutral, portable, steps, saves):
    with running(
        Settings(iterations=5, goal=Portable() if portable else Pressure()), output=Path("out")
    ) as host:
        model = host.model()
        state = host.session.models[model]
        state.steps = steps
        state.store.stop = 0.01  # which is given and not learned
        if not neutral:
            state.store.open(torch.full((30,), 0.5))
        monkeypatch.setattr(host.session.adapter, "save_model", lambda *_: Path("there"))
        assert (host.session.save_learned() is not None) is saves


@pytest.mark.parametrize("error", [OSError(), ModuleNotFoundError("no torchvision\nat all")])
def test_a_metric_without_its_weights_is_nan_be_it_a_function_or_a_class(error, caplog):
    class Metric:
        def __init__(self):
            raise error

    def metric():
        raise error

    for each in (Metric, metric):
        session = SimpleNamespace(absent=set())
        seam = Seam(Role.METRIC, "a_module", each.__name__)
        answers = [on_metric(session, SeamCall(seam, each, None, (), {})) for _ in range(2)]
        for answer in answers:
            number = answer.to("cpu")(torch.zeros(3), torch.zeros(3)) if each is Metric else answer
            assert number.isnan()
    assert len(caplog.messages) == 2
    assert all("it is NaN" in said and "\n" not in said for said in caplog.messages)


def test_what_scales_a_loss_is_wrapped_where_this_torch_has_it():
    assert import_module(SCALER.module).GradScaler.scale


@pytest.mark.skipif(torch.__version__ < "2.3", reason="torch scales no gradient on a CPU")
@pytest.mark.parametrize(("learn", "enabled"), [(True, True), (True, False), (False, True)])
def test_a_scaled_loss_is_refused_where_the_pressure_would_vanish_beside_it(learn, enabled):
    scaler, loss = torch.amp.GradScaler("cpu", enabled=enabled), torch.tensor(1.0)
    with running(learn=learn):
        if learn and enabled:
            with pytest.raises(UsageError, match="the pressure vanishes"):
                scaler.scale(loss)
        else:
            assert scaler.scale(loss) >= loss
    assert scaler.scale(loss) >= loss
