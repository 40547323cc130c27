"""A frame is timed from an idle device to an idle device, its backward pass included."""

from types import SimpleNamespace

import pytest
import torch

from fragprune_plugins.engines import create_engine
from fragprune_plugins.types import RasterInputs
from fragprune_plugins.workbench.bench import timing
from fragprune_plugins.workbench.bench.scene import make_scene, make_view
from fragprune_plugins.workbench.bench.timing import Case
from fragprune_plugins.workbench.figures import clock
from fragprune_plugins.workbench.figures.evaluate import Candidate, measure_all


class Notes:
    """An engine that notes when it draws and when its picture is differentiated."""

    name = "notes"

    def __init__(self, events):
        self.events = events
        self.inner = create_engine("auto")

    def rasterize(self, inputs, thresholds):
        self.events.append("draw")
        outputs = self.inner.rasterize(inputs, thresholds)
        if outputs.image.requires_grad:
            outputs.image.register_hook(lambda _: self.events.append("backward"))
        return outputs


@pytest.fixture
def events(monkeypatch):
    """What happens, first to last; devices are waited for as "idle"."""
    noted = []
    monkeypatch.setattr(clock, "synchronize", lambda device: noted.append(f"idle {device}"))
    return noted


def test_a_gpu_is_waited_for_by_its_number_and_a_cpu_is_not(monkeypatch):
    waited = []
    monkeypatch.setattr(torch.cuda, "synchronize", waited.append)
    clock.synchronize(torch.device("cpu"))
    assert waited == []
    clock.synchronize(torch.device("cuda:1"))
    assert waited == [torch.device("cuda:1")]


def test_the_clock_runs_from_idle_to_idle(events, monkeypatch):
    ticks = iter([1.0, 1.25])
    counter = SimpleNamespace(perf_counter=lambda: events.append("clock") or next(ticks))
    monkeypatch.setattr(clock, "time", counter)
    made, spent = clock.timed(lambda: events.append("work") or "made", torch.device("cuda"))
    assert events == ["idle cuda", "clock", "work", "idle cuda", "clock"]
    assert (made, spent) == ("made", 250.0)


def test_every_timed_frame_of_a_measurement_waits(events, truth, dataset):
    shots = dataset.test
    measure_all([Candidate(truth)] * 2, shots, engine=Notes(events), repeats=3)
    looked_at, frames = 2 * 2 * len(shots), 3 * 2 * len(shots)
    assert events[:looked_at] == ["draw"] * looked_at
    assert events[looked_at:] == ["idle cpu", "draw", "idle cpu"] * frames


@pytest.mark.parametrize(
    ("kind", "frame"), [("forward", ["draw"]), ("forward_backward", ["draw", "backward"])]
)
def test_every_timed_frame_of_the_bench_waits(events, kind, frame):
    inputs = RasterInputs(make_view(24, 16), make_scene(60).splats(), planes=())
    case = Case("tiny", inputs, kind=kind)
    timing.measure([case], [Notes(events)], repeats=2)
    assert events == frame + 2 * ["idle cpu", *frame, "idle cpu"]


def test_the_memory_of_a_gpu_is_what_torch_gave_out(monkeypatch):
    told = []
    for name, answer in (("memory_allocated", 3 << 20), ("max_memory_allocated", 8 << 20)):
        monkeypatch.setattr(torch.cuda, name, lambda _, answer=answer: answer)
    for name in ("synchronize", "reset_peak_memory_stats"):
        monkeypatch.setattr(torch.cuda, name, lambda _, name=name: told.append(name))
    outputs, peak = timing._with_peak(lambda: told.append("job"), torch.device("cuda"))
    assert told == ["synchronize", "reset_peak_memory_stats", "job"]
    assert (outputs, peak) == (None, 5.0)
