"""What is measured: rows, repeats, turns, stages, pictures compared; and what is made of it."""

from dataclasses import replace
from typing import Any

import pytest
import torch

from fragprune_plugins.engines import create_engine
from fragprune_plugins.types import RasterInputs, RasterOutputs
from fragprune_plugins.workbench.bench import timing as bench
from fragprune_plugins.workbench.bench.scene import make_scene, make_view
from fragprune_plugins.workbench.bench.timing import Case, measure
from fragprune_plugins.workbench.bench.work import _saved

ROW = {
    *("scene", "width", "height", "gaussians", "pass", "engine", "device", "threads", "truncated"),
    *("fragments_per_pixel", "evaluated_per_pixel", "ms_median", "ms_min", "ms_se"),
    *("ns_per_fragment", "stages", "peak_mb", "difference"),
}


class Recorder:
    """An engine that notes who is called when, and draws through another."""

    def __init__(self, name: str, log: list[str], shift: float = 0.0) -> None:
        self.name = name
        self.log = log
        self.shift = shift
        self.inner = create_engine("auto")

    def rasterize(self, inputs: RasterInputs, thresholds: torch.Tensor | None) -> RasterOutputs:
        self.log.append(self.name)
        out = self.inner.rasterize(inputs, thresholds)
        return replace(out, image=out.image + self.shift, stages={"blend": 0.001})


def case(kind: bench.Pass = "forward", cut: float | None = None) -> Case:
    thresholds = None if cut is None else torch.full((200,), cut)
    return Case("tiny", make_view(40, 30), make_scene(200).splats(), kind, thresholds)


def test_one_row_a_case_and_engine() -> None:
    cases = [case(), case(cut=0.1), case("forward_backward"), case("forward_backward", 0.1)]
    told: list[str] = []
    rows = measure(cases, [create_engine("auto")], repeats=3, say=told.append)
    assert [set(row) for row in rows] == [ROW] * 4
    assert [row["truncated"] for row in rows] == [False, True, False, True]
    assert [row["pass"] for row in rows] == 2 * ["forward"] + 2 * ["forward_backward"]
    assert len(told) == 3
    for row in rows:
        assert (row["width"], row["height"], row["gaussians"]) == (40, 30, 200)
        assert 0 < row["ms_min"] <= row["ms_median"]
        assert row["ms_se"] >= 0
        assert row["peak_mb"] is None or row["peak_mb"] >= 0
        assert row["evaluated_per_pixel"] >= row["fragments_per_pixel"] > 0
        assert row["difference"] == 0
    assert rows[1]["fragments_per_pixel"] < rows[0]["fragments_per_pixel"]
    assert rows[2]["fragments_per_pixel"] == rows[0]["fragments_per_pixel"]


def test_engines_take_turns_and_the_order_is_reversed_each_round() -> None:
    log: list[str] = []
    engines = [Recorder("a", log), Recorder("b", log, shift=0.5)]
    rows = measure([case()], engines, repeats=3)
    assert "".join(log) == "ab" + "ab" + "ba" + "ab"  # one round to warm up
    assert [row["engine"] for row in rows] == ["a", "b"]
    assert [row["difference"] for row in rows] == [0, pytest.approx(0.5)]


def test_stages_are_medians_and_backward_is_the_rest() -> None:
    forward, both = measure([case(), case("forward_backward")], [Recorder("a", [])], repeats=3)
    assert forward["stages"] == {"blend": 0.001}
    assert set(both["stages"]) == {"blend", "backward"}
    assert 0 < both["stages"]["backward"] < both["ms_median"] + both["ms_se"] * 10


def test_gradients_start_from_nothing_each_time() -> None:
    seen: list[float] = []

    class Engine(Recorder):
        def rasterize(self, inputs: RasterInputs, thresholds: Any) -> RasterOutputs:
            grad = inputs.splats.opacities.grad
            seen.append(0.0 if grad is None else float(grad.abs().sum()))
            return super().rasterize(inputs, thresholds)

    measure([case("forward_backward", 0.1)], [Engine("a", [])], repeats=2)
    assert seen == [0, 0, 0]


def row(ms: float, fragments: float, truncated: bool) -> dict[str, Any]:
    given = {"scene": "s", "width": 8, "height": 6, "gaussians": 5, "pass": "forward"}
    figures = {"ms_median": ms, "fragments_per_pixel": fragments, "truncated": truncated}
    return {**given, **figures}


def test_what_was_saved_is_the_ratio_of_the_two_ratios() -> None:
    found = _saved([row(30, 50, False), row(20, 25, True)])
    assert found == {"s 8x6": {"fragments": 2.0, "time": 1.5, "share": pytest.approx(0.75)}}


def test_a_picture_truncated_to_nothing_saved_nothing_that_has_a_share() -> None:
    assert _saved([row(30, 50, False), row(20, 0, True)]) == {}
