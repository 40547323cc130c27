"""What a step costs besides drawing: on a GPU, each number read back stops it."""

from collections import Counter
from unittest.mock import Mock

import pytest
import torch
from miniatures.vanilla_3dgs import joint
from torch.overrides import TorchFunctionMode
from torch.utils._python_dispatch import TorchDispatchMode

from fragprune_plugins.engines.reference import ReferenceEngine
from fragprune_plugins.hosts import seams
from fragprune_plugins.learning.schedule import Settings
from fragprune_plugins.plugins.hookspecs import hookimpl

ROWS = 40


class Costs(TorchDispatchMode):
    """Counts numbers read back, and medians and sorts of as many numbers as there are rows."""

    def __init__(self):
        super().__init__()
        self.found = Counter()

    def __torch_dispatch__(self, func, types, args=(), kwargs=None):
        if func is torch.ops.aten._local_scalar_dense.default:
            self.found["read back"] += 1
        elif func.overloadpacket in (torch.ops.aten.median, torch.ops.aten.sort):
            self.found["sorted"] += args[0].numel() >= ROWS
        return func(*args, **(kwargs or {}))


def test_drawing_a_view_that_is_known_reads_nothing_back():
    with joint(Settings(iterations=30, train="opacity")) as host:
        model, camera = host.model(ROWS), host.camera()
        for iteration in (1, 2, 3):
            host.step(model, camera, iteration)
        model.update_learning_rate(4)
        for _ in range(2):  # views of one step
            with Costs() as costs:
                image = host.render(camera, model)["render"]
            assert image.requires_grad
            assert not costs.found


class Detour(TorchFunctionMode):
    """Counts torch calls that pass by, as they pass the redirection of ``--device cpu``."""

    calls = 0

    def __torch_function__(self, func, types, args=(), kwargs=None):
        self.calls += 1
        return func(*args, **(kwargs or {}))


def test_signatures_are_read_once(monkeypatch):
    with joint(Settings(iterations=30)) as host:
        model, camera = host.model(ROWS), host.camera()
        host.step(model, camera, 1)
        read = Mock(side_effect=seams.signature)
        monkeypatch.setattr(seams, "signature", read)
        host.step(model, camera, 2)
    assert not read.called


@pytest.mark.parametrize("iterations", [0, 1], ids=["without thresholds", "with"])
def test_the_engine_takes_no_detour_but_the_host_does(iterations):
    def drawn(engine_calls):
        """The detours of one view, if the engine makes that many torch calls more."""

        class Talkative(ReferenceEngine):
            def rasterize(self, inputs, thresholds):
                for _ in range(engine_calls):
                    torch.zeros(1)
                return super().rasterize(inputs, thresholds)

            @hookimpl
            def fragprune_create_engine(self):
                return self

        with joint(Settings(iterations=30), plugins=[Talkative()]) as host:
            model, camera = host.model(ROWS), host.camera()
            for iteration in range(iterations):
                host.step(model, camera, iteration + 1)
            model.update_learning_rate(iterations + 1)
            with Detour() as detour:
                host.render(camera, model)
            return detour.calls

    assert drawn(0) == drawn(100) > 0


def test_figures_of_a_step_are_worked_out_once_for_all_its_views():
    seen = []

    class Observer:
        @hookimpl
        def fragprune_step(self, stats):
            seen.append(stats)

    with joint(Settings(iterations=30, train="opacity"), plugins=[Observer()]) as host:
        model, cameras = host.model(ROWS), [host.camera(side=s) for s in (-0.4, 0.0, 0.4)]
        with Costs() as costs:
            for iteration in (1, 2):
                model.update_learning_rate(iteration)
                for camera in cameras:
                    host.render(camera, model)["render"].mean().backward()
                model.optimizer.step()
                model.optimizer.zero_grad(set_to_none=True)
            host.finish()
    assert [stats.step for stats in seen] == [1, 2]
    assert all(type(value) in (int, float) for stats in seen for value in vars(stats).values())
    assert costs.found["sorted"] == 2
