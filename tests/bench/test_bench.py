"""fragprune bench: its scene, what is measured, and what the command says of it."""

import hashlib
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
import torch
from cli.commands import run, run_json, succeeds
from finetune import tiny

from fragprune_plugins import Model, RasterInputs, RasterOutputs
from fragprune_plugins.engines import create_engine
from fragprune_plugins.workbench.bench import timing, work
from fragprune_plugins.workbench.bench.scene import make_scene, make_view
from fragprune_plugins.workbench.bench.timing import Case, measure
from fragprune_plugins.workbench.models.formats.ply import write_ply

COLUMNS = ("xyz", "f_dc", "f_rest", "opacity", "scaling", "rotation")
DIGEST = "f817cb6da8fd62dc50b6708bc3d1ff33eb9ef1bac9659ece73ee8aaf77c8b582"
"""Of make_scene(1000). Computed in float64 and rounded to float32, so that another library's last
digit changes no bit. If it changes all the same, published figures are of another scene."""


def digest(scene: Model) -> str:
    found = hashlib.sha256()
    for name in COLUMNS:
        found.update(getattr(scene, name).numpy().astype("<f4").tobytes())
    return found.hexdigest()


def test_the_arrays_have_the_stored_digest_and_another_seed_is_another_scene() -> None:
    assert digest(make_scene(1000)) == DIGEST
    assert digest(make_scene(50, seed=1)) != digest(make_scene(50, seed=2))


@pytest.mark.parametrize("count", [1, 7, 64])
def test_any_count(count: int) -> None:
    scene = make_scene(count)
    assert scene.xyz.shape == (count, 3)
    assert scene.f_rest.shape == (count, 15, 3)
    assert all(getattr(scene, name).isfinite().all() for name in COLUMNS)


@pytest.mark.parametrize("size", [(80, 60), (161, 120)])
def test_the_camera_sees_the_scene_at_any_size(size: tuple[int, int]) -> None:
    view = make_view(*size)
    assert view.tan_fov_x == pytest.approx(0.6)
    assert torch.equal(view.background, torch.zeros(3))
    out = create_engine("auto").rasterize(RasterInputs(view, make_scene(4000).splats()), None)
    assert (out.radii > 0).double().mean() > 0.6
    assert out.fragments_per_pixel > 5


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


def case(kind: timing.Pass = "forward", cut: float | None = None) -> Case:
    thresholds = None if cut is None else torch.full((200,), cut)
    inputs = RasterInputs(make_view(40, 30), make_scene(200).splats(), planes=())
    return Case("tiny", inputs, thresholds, kind)


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


SMALL = ("--size", "40x30", "--gaussians", 200)


@pytest.fixture(autouse=True)
def two_rounds(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(work, "REPEATS", 2)


def test_every_size_and_count() -> None:
    sizes = ("--size", "24x16", "--size", "33x17")
    counts = ("--gaussians", 50, "--gaussians", 120)
    found = run_json("bench", *sizes, *counts, "--threads", 1)
    assert set(found) == {"results", "saved", "machine"}
    rows, saved = found["results"], found["saved"]
    assert len(rows) == 2 * 2 * 2 * 2
    assert {row["threads"] for row in rows} == {1}
    names = [f"bench-{count} {size}" for count in (50, 120) for size in ("24x16", "33x17")]
    assert sorted(saved) == sorted(names)
    forward = [row for row in rows if row["pass"] == "forward"]
    plain, cut = ([row for row in forward if row["truncated"] == truth] for truth in (False, True))
    for row, other in zip(plain, cut, strict=True):
        pixels = row["width"] * row["height"]
        price = 1e6 * row["ms_median"] / (row["fragments_per_pixel"] * pixels)
        assert row["ns_per_fragment"] == pytest.approx(price)
        fragments = row["fragments_per_pixel"] / other["fragments_per_pixel"]
        time = row["ms_median"] / other["ms_median"]
        ratios = {"fragments": fragments, "time": time, "share": time / fragments}
        entry = saved[f"{row['scene']} {row['width']}x{row['height']}"]
        assert set(entry) == {*ratios, "time_se", "beyond_noise"}
        assert {name: entry[name] for name in ratios} == pytest.approx(ratios)
    assert set(found["machine"]) == {
        *("processor", "cores", "load_before", "load_after", "platform", "torch", "native", "gpu")
    }


@pytest.mark.parametrize(
    ("ms", "said"),
    [(20, " 1.50 ± 0.04x as fast (75% of it)"), (29, ": no difference beyond the noise")],
)
def test_a_ratio_of_times_is_quoted_beyond_the_noise_alone(ms: float, said: str) -> None:
    same = {"scene": "s", "width": 8, "height": 6, "pass": "forward", "ms_se": 0.4}
    plain = {"ms_median": 30, "fragments_per_pixel": 50}
    cut = {"ms_median": ms, "fragments_per_pixel": 25}
    (saved,) = work._saved([same | plain, same | cut]).values()
    assert work._phrase(saved) == f"2.00x fewer fragments, frames{said}"


def test_the_text_says_what_was_saved_and_how_busy_the_machine_was() -> None:
    said = succeeds("bench", *SMALL)
    assert "x fewer fragments" in said.stdout
    assert "load" in said.stdout.splitlines()[-1]
    assert "round 2 of 2" in said.stderr


@pytest.mark.parametrize("learned", [None, 0.5, 0.999999])
def test_a_model_of_ones_own_with_its_thresholds(tmp_path: Path, learned: float | None) -> None:
    model = tmp_path / "mine.ply"
    splat = tiny.random_model()
    write_ply(model, tiny.cut(splat, learned) if learned else splat)
    cameras = tiny.write_path(tmp_path / "cameras.json", ["a"])
    found = run_json("bench", model, "--cameras", cameras, "--size", "32x32")
    rows = found["results"]
    assert [(row["scene"], row["gaussians"]) for row in rows] == [("mine", 60)] * 4
    plain, cut = (row["fragments_per_pixel"] for row in rows if row["pass"] == "forward")
    assert bool(found["saved"]) == (cut > 0) == (learned != 0.999999)  # of nothing no share
    assert (cut < 0.5 * plain) == bool(learned)
    assert timing.TRUNCATION < 0.1


def test_a_system_without_a_load_average(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.delattr("os.getloadavg")
    assert "load unknown" in run("bench", *SMALL).stdout
