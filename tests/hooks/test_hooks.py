"""One test a hook: what a plugin answers has its effect; what it is told is true."""

import re
from dataclasses import replace
from functools import partial
from pathlib import Path
from types import ModuleType

import pytest
import scenes
import torch
from miniatures.vanilla_3dgs import HOST, joint, running

from fragprune_plugins import Pressure, Schedule, Settings, ThresholdStore
from fragprune_plugins.adapting import HostRepo, Plain, hookimpl
from fragprune_plugins.engines import create_engine
from fragprune_plugins.hosts.choosing import choose
from fragprune_plugins.plugins import hookspecs
from fragprune_plugins.plugins.hooks import select_adapter, thresholds_for
from fragprune_plugins.plugins.loading import Plugins
from fragprune_plugins.workbench.check.work import judge, models_of
from fragprune_vanilla_3dgs import Vanilla3DGS

HOOKS = [name for name in vars(hookspecs) if name.startswith("fragprune_")]
DOCS = Path(__file__).parents[2] / "docs"


class Recorder:
    def __init__(self):
        self.events = []

    @hookimpl
    def fragprune_attached(self, model, store):
        self.events.append(("attached", model, store))

    @hookimpl
    def fragprune_population_changed(self, store, change):
        self.events.append(("changed", len(store), change))

    @hookimpl
    def fragprune_step(self, stats):
        self.events.append(("step", stats))

    @hookimpl
    def fragprune_saved(self, path):
        self.events.append(("saved", path))

    @hookimpl
    def fragprune_finished(self, summary):
        self.events.append(("finished", summary))

    def of(self, kind):
        return [event[1:] for event in self.events if event[0] == kind]


def test_every_hook_has_a_test():
    assert not [hook for hook in HOOKS if f"test_hook_{hook}" not in globals()]


def test_the_plugin_on_the_page_works(plug):
    page = (DOCS / "explanation" / "plugins.md").read_text()
    (code,) = re.findall(r"```python\n(.*?)```", page, re.DOTALL)
    plugin = ModuleType("plugin")
    exec(code, vars(plugin))
    plug(plugin)
    store = ThresholdStore(60)
    store.open(torch.full((60,), 0.5))
    assert torch.equal(thresholds_for(scenes.random_scene(0), store), torch.full((60,), 0.05))


def test_hook_fragprune_select_adapter():
    class Fork(Vanilla3DGS):
        name = "a-fork"

    class Plugin:
        @hookimpl
        def fragprune_select_adapter(self, repo, matches):
            assert repo.root == HOST
            return matches[-1].adapter

    plugins = Plugins()
    plugins.register(Plugin(), "mine")
    select = partial(select_adapter, plugins=plugins)
    chosen = choose(HostRepo(HOST), [Vanilla3DGS(), Fork()], select=select)
    assert chosen.name == "a-fork"


def test_hook_fragprune_read_models(tmp_path):
    class Reader:
        @hookimpl
        def fragprune_read_models(self, repo):
            return [Plain((), "Model")] if repo.root == tmp_path else None

    plugins = Plugins()
    assert not any(models_of(HostRepo(tmp_path), plugins))
    plugins.register(Reader(), "mine")
    assert all(models_of(HostRepo(tmp_path), plugins))
    told = judge(HostRepo(tmp_path), {}, [], plugins)
    assert told.kind == "finetune"


def test_hook_fragprune_truncate():
    seen = []

    class Fixed:
        @hookimpl
        def fragprune_truncate(self, inputs, store):
            seen.append((len(inputs.splats), len(store)))
            return torch.full((len(store),), 0.999999)

    with joint(plugins=[Fixed()]) as host:
        model, camera = host.model(), host.camera()
        assert host.render(camera, model)["render"].any()
        assert seen == []  # nobody is asked about a neutral store
        model.update_learning_rate(1)
        background = torch.tensor([0.2, 0.4, 0.6])
        image = host.render(camera, model, background)["render"]
        assert torch.equal(image, background[:, None, None].expand_as(image))  # all was truncated
        with host.paused():
            assert not torch.equal(host.render(camera, model, background)["render"], image)
    assert seen == [(30, 30)]


def test_hook_fragprune_create_engine():
    asked = []

    class Mine:
        name = "mine"

        def rasterize(self, inputs, thresholds):
            return create_engine("reference").rasterize(inputs, thresholds)

    class Plugin:
        @hookimpl
        def fragprune_create_engine(self, name, device):
            asked.append((name, device.type))
            return Mine()

    with joint(plugins=[Plugin()], engine="mine") as host:
        host.step(host.model(), host.camera(), 1)
        assert host.finish().engine == "mine"
    assert asked == [("mine", "cpu")]


def test_hook_fragprune_create_schedule():
    class Late(Schedule):
        def at(self, step):
            return replace(super().at(step), learn=step > 2)

    class Plugin:
        @hookimpl
        def fragprune_create_schedule(self, settings):
            return Late(settings)

    with running(plugins=[Plugin()], freeze=False) as host:
        model, camera = host.model(), host.camera()
        neutral = []
        for iteration in (1, 2, 3):
            host.step(model, camera, iteration)
            neutral.append(host.store(model).neutral)
        assert neutral == [True, True, False]


def test_hook_fragprune_attached(tmp_path):
    recorder = Recorder()
    with joint(plugins=[recorder]) as host:
        model = host.model()
        assert recorder.of("attached") == [(model, host.store(model))]
        host.step(model, host.camera(), 1)
        model.save_ply(str(tmp_path / "a.ply"))
        other = host.model(setup=False)
        other.load_ply(str(tmp_path / "a.ply"))
        assert recorder.of("attached")[1:] == [(other, host.store(other))]


def test_hook_fragprune_population_changed():
    recorder = Recorder()
    with joint(plugins=[recorder]) as host:
        model = host.model(20)
        model.prune_points(torch.arange(20) < 5)
        model.densify_and_clone(torch.ones(15, 1), 0.5, 1e9)
        model.training_setup(host.arguments)  # a new optimizer for the same rows
        model._xyz = torch.nn.Parameter(model._xyz.detach().clone())
        host.store(model).open(host.adapter.opacities(model))
        model.training_setup(host.arguments)  # other rows, as re-initialising makes them
        assert host.store(model).neutral
    changes = recorder.of("changed")
    assert [(c.operation, c.before, c.after) for _, c in changes] == [
        ("keep", 20, 15),
        ("append", 15, 30),
        ("training_setup", 30, 30),
    ]
    assert [rows for rows, _ in changes] == [c.after for _, c in changes]


def test_hook_fragprune_step():
    recorder = Recorder()
    with joint(Settings(iterations=20, goal=Pressure(3e-4)), plugins=[recorder]) as host:
        model, camera = host.model(), host.camera()
        for iteration in range(1, 4):
            host.step(model, camera, iteration)
        host.finish()
        assert host.curves == [vars(stats) for (stats,) in recorder.of("step")]
    stats = [s for (s,) in recorder.of("step")]
    assert [s.step for s in stats] == [1, 2, 3]
    assert all(s.fragments_per_pixel > 0 for s in stats)
    assert all(s.pressure == 3e-4 and 0 < s.threshold_median < 1 for s in stats)


def test_hook_fragprune_saved(tmp_path):
    recorder = Recorder()
    with joint(plugins=[recorder]) as host:
        model = host.model()
        model.save_ply(str(tmp_path / "neutral.ply"))
        host.step(model, host.camera(), 1)
        model.save_ply(str(tmp_path / "a.ply"))
    assert recorder.of("saved") == [(tmp_path / "a.fragprune.safetensors",)]
    assert not (tmp_path / "neutral.fragprune.safetensors").exists()


def test_hook_fragprune_finished():
    recorder = Recorder()
    with joint(Settings(iterations=20, stop=None, seed=3), plugins=[recorder]) as host:
        host.step(host.model(), host.camera(), 1)
        summary = host.finish()
    assert recorder.of("finished") == [(summary,)]
    assert (summary.adapter, summary.steps, summary.gaussians) == ("vanilla-3dgs", 1, 30)
    assert summary.fragments_before == pytest.approx(summary.fragments_after)
    assert summary.settings["seed"] == 3
