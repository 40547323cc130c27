"""A plugin that fails in a hook is named; what it answers is looked at before it is used."""

import logging
from functools import partial
from inspect import signature
from types import SimpleNamespace

import pytest
import scenes
import torch
from cli.commands import fails
from finetune import tiny
from miniatures.vanilla_3dgs import HOST, joint

from fragprune_plugins import Settings, ThresholdStore, save
from fragprune_plugins.adapting import HostRepo, hookimpl
from fragprune_plugins.errors import InputError, PluginError, UnknownHostError
from fragprune_plugins.hosts.choosing import choose
from fragprune_plugins.hosts.findings import Match
from fragprune_plugins.plugins import hookspecs
from fragprune_plugins.plugins.hooks import engine_for, schedule_for, select_adapter, thresholds_for
from fragprune_plugins.plugins.loading import Plugins
from fragprune_plugins.workbench.check.work import models_of
from fragprune_vanilla_3dgs import Vanilla3DGS

COUNT = 60
MATCHES = [Match(name, True) for name in ("a-host", "b-host")]


def learned() -> ThresholdStore:
    store = ThresholdStore(COUNT)
    store.open(torch.full((COUNT,), 0.5))
    return store


ASK = {
    "fragprune_truncate": lambda p: thresholds_for(scenes.random_scene(0), learned(), p),
    "fragprune_create_engine": lambda p: engine_for("auto", "cpu", p),
    "fragprune_create_schedule": lambda p: schedule_for(Settings(), p),
    "fragprune_select_adapter": lambda p: select_adapter(HostRepo(HOST), MATCHES, p),
    "fragprune_read_models": lambda p: models_of(HostRepo(HOST), p),
}
"""What makes the core ask."""

OBSERVERS = [name for name in vars(hookspecs) if name[:10] == "fragprune_" and name not in ASK]


def plugin(hook, act):
    """A plugin that does something in one hook; every argument of the hook is taken."""

    def answer(*_):
        return act()

    answer.__signature__ = signature(getattr(hookspecs, hook))
    return SimpleNamespace(**{hook: hookimpl(answer)})


def raising(error):
    def act():
        raise error

    return act


def with_one(hook, act):
    plugins = Plugins()
    plugins.register(plugin(hook, act), "mine")
    return plugins


@pytest.mark.parametrize(
    "error",
    [RuntimeError("no table"), SystemExit(7), InputError("here", "x", "y", "Do z.")],
    ids=lambda error: type(error).__name__,
)
@pytest.mark.parametrize("hook", ASK)
def test_a_raise_names_plugin_hook_cause_and_line(hook, error):
    with pytest.raises(PluginError) as raised:
        ASK[hook](with_one(hook, raising(error)))
    assert raised.value.where == f"plugin mine, {hook}"
    assert raised.value.found.startswith(f"{type(error).__name__}: {error} (test_isolation.py:")
    assert "FRAGPRUNE_BLOCK=mine" in raised.value.remedy
    assert raised.value.__cause__ is error


@pytest.mark.parametrize("hook", ASK)
def test_ctrl_c_in_a_hook_stays_the_users(hook):
    with pytest.raises(KeyboardInterrupt):
        ASK[hook](with_one(hook, raising(KeyboardInterrupt())))


@pytest.mark.parametrize("hook", ASK)
def test_a_plugin_without_an_answer_leaves_it_to_us(hook):
    own = ASK[hook](Plugins())
    left = ASK[hook](with_one(hook, lambda: None))
    if isinstance(own, torch.Tensor):
        assert torch.equal(own, left)
    else:
        assert type(left) is type(own)


@pytest.mark.parametrize(
    ("hook", "answer", "words"),
    [
        ("fragprune_create_engine", 3, "3; expected an engine"),
        ("fragprune_create_engine", SimpleNamespace(name="mine"), "expected an engine"),
        ("fragprune_create_engine", SimpleNamespace(rasterize=print), "expected an engine"),
        ("fragprune_create_schedule", "soon", "'soon'; expected a schedule"),
        ("fragprune_create_schedule", SimpleNamespace(at=print), "expected a schedule"),
        ("fragprune_select_adapter", "c-host", "'c-host'; expected one of a-host, b-host"),
        ("fragprune_select_adapter", 1, "expected one of a-host, b-host"),
        ("fragprune_truncate", 0.1, r"0\.1; expected \(60,\) floating-point thresholds"),
        ("fragprune_truncate", torch.full((59,), 0.1), r"\(59,\) on cpu"),
        ("fragprune_truncate", torch.full((60, 1), 0.1), r"\(60, 1\)"),
        ("fragprune_truncate", torch.ones(60, dtype=torch.int64), r"torch\.int64"),
        ("fragprune_truncate", torch.full((60,), 0.1, device="meta"), "on meta"),
        ("fragprune_truncate", torch.tensor([0.1] * 58 + [0.0, 1.0]), "2 thresholds outside"),
        ("fragprune_truncate", torch.full((60,), torch.nan), "60 thresholds outside"),
    ],
)
def test_an_answer_that_cannot_be_used_is_refused(hook, answer, words):
    with pytest.raises(PluginError, match=f"plugin mine, {hook}: .*{words}"):
        ASK[hook](with_one(hook, lambda: answer))


class Mine:
    """A plugin, and its engine, which draws nothing that can be used."""

    name = "mine"

    def __init__(self, answer=None):
        self.answer = answer

    @hookimpl
    def fragprune_create_engine(self, name, device):
        return self if name == "mine" else None

    def rasterize(self, inputs, thresholds):
        return self.answer


@pytest.mark.parametrize(("answer", "said"), [(None, "None"), (0.5, "0.5")])
def test_an_engine_that_gives_no_outputs_is_named(answer, said):
    named = f"engine mine of {Mine.__module__}: {said}; expected RasterOutputs"
    with joint(plugins=[Mine(answer)], engine="mine") as host:
        model = host.model()
        with pytest.raises(PluginError, match=named):
            host.render(host.camera(), model)


@pytest.mark.parametrize(
    "words",
    ["profile a.ply --orbit", "finetune a.ply --self --out b.ply", "audit a.ply --out c", "bench"],
)
def test_an_engine_that_gives_no_outputs_is_named_by_commands(plug, tmp_path, monkeypatch, words):
    monkeypatch.chdir(tmp_path)
    save("a.ply", tiny.random_model(8))
    plug(Mine())
    named = f"engine mine of {Mine.__module__}: None; expected RasterOutputs"
    fails(*words.split(), "--engine", "mine", says=named, code=1)


def test_of_two_engines_of_one_name_the_one_that_draws_is_told(caplog):
    plugins, first, last = Plugins(), Mine(), Mine()
    plugins.register(first, "first")
    assert engine_for("mine", "cpu", plugins) is first
    assert caplog.messages == []
    plugins.engines.clear()
    plugins.register(last, "last")
    assert engine_for("mine", "cpu", plugins) is last
    (said,) = caplog.messages
    assert "engine mine: of plugins last, first the first" in said
    assert "FRAGPRUNE_BLOCK" in said


def test_an_adapter_that_raises_while_it_reads_a_host_does_not_fit_and_stops_no_other():
    class Broken(Vanilla3DGS):
        name = "broken"

        def fingerprint(self, repo):
            raise KeyError("revision")

    repo = HostRepo(HOST)
    assert choose(repo, [Broken(), Vanilla3DGS()]).name == "vanilla-3dgs"
    with pytest.raises(UnknownHostError, match="adapter broken: KeyError: 'revision'"):
        choose(repo, [Broken()])


def learn(plugins, tmp_path):
    """Three steps, a change of rows, a saved model, the end: every observer is told; the logits."""
    with joint(Settings(iterations=20), plugins=plugins) as host:
        model, camera = host.model(20), host.camera()
        for iteration in (1, 2, 3):
            host.step(model, camera, iteration)
        model.prune_points(torch.arange(20) < 5)
        model.save_ply(str(tmp_path / "a.ply"))
        host.finish()
        return host.store(model).logits.detach().clone()


def others(told):
    """An observer of everything that notes what it is told."""
    noting = [plugin(name, partial(told.append, name)) for name in OBSERVERS]
    return SimpleNamespace(**{name: vars(each)[name] for each in noting for name in vars(each)})


@pytest.fixture(scope="module")
def alone(tmp_path_factory):
    """What the others learn and are told where nobody raises."""
    told: list[str] = []
    return learn([others(told)], tmp_path_factory.mktemp("alone")), told


@pytest.mark.parametrize(
    ("hook", "error"),
    [*((hook, RuntimeError("disk full")) for hook in OBSERVERS), ("fragprune_step", SystemExit(7))],
    ids=str,
)
def test_an_observer_that_raises_is_off_and_the_run_goes_on(hook, error, alone, tmp_path, caplog):
    told, calls = [], []

    def act():
        calls.append(hook)
        raise error

    with caplog.at_level(logging.WARNING, logger="fragprune"):
        assert torch.equal(learn([others(told), plugin(hook, act)], tmp_path), alone[0])
    assert told == alone[1]
    assert set(told) == set(OBSERVERS)
    assert calls == [hook]
    said = [record.getMessage() for record in caplog.records]
    (line,) = [text for text in said if "plugin test-1" in text]
    assert f"plugin test-1, {hook}: {type(error).__name__}: {error} (test_isolation.py:" in line
