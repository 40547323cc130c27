"""Prices of a machine: what is fitted, what is kept, what is refused."""

from __future__ import annotations

import json
import math
from pathlib import Path
from typing import Any

import pytest
import torch
from cli.commands import run, run_json
from hypothesis import given
from hypothesis import strategies as st

from fragprune_plugins.engines import create_engine
from fragprune_plugins.errors import CostError
from fragprune_plugins.types import RasterInputs
from fragprune_plugins.workbench.prices import calibration
from fragprune_plugins.workbench.prices.cost import UNITS, Cost, fit, work_of
from fragprune_plugins.workbench.prices.scene import make_scene, make_view

PRICES = dict(zip(UNITS, (5e4, 1.5, 60.0, 30.0, 0.25, 0.125), strict=True))


def works(count: int, seed: int = 0) -> list[dict[str, float]]:
    """Counts that vary independently over orders of magnitude, as sizes and scenes make them."""
    stream = torch.Generator().manual_seed(seed)
    powers = 3 + 4 * torch.rand(count, len(UNITS), generator=stream, dtype=torch.float64)
    return [dict(zip(UNITS, row, strict=True)) | {"frame": 1.0} for row in (10**powers).tolist()]


@given(st.integers(0, 1000), st.sampled_from([*UNITS, None]))
def test_known_prices_are_found_again_and_what_is_free_costs_nothing(seed, free):
    prices = PRICES | ({free: 0.0} if free else {})
    counted = works(60, seed)
    found = fit(counted, [Cost(prices).ms(work) for work in counted])
    for unit in UNITS:  # the sum of squares is flat to 1e-16; prices to about its root
        assert found[unit] == pytest.approx(prices[unit], rel=1e-4, abs=1e-6 * PRICES[unit])


def test_noise_never_makes_a_price_negative():
    counted = works(40)
    noisy = [
        max(1e-3, Cost(PRICES).ms(w) * (1 + 0.3 * math.sin(7 * i))) for i, w in enumerate(counted)
    ]
    assert all(price >= 0 for price in fit(counted, noisy).values())


def few_frames() -> list[calibration.Frame]:
    frames: list[calibration.Frame] = []
    for count in (20, 60):
        splats = make_scene(count).splats()
        for size in ((16, 16), (40, 30), (64, 48)):
            inputs = RasterInputs(make_view(*size), splats, scale_modifier=20.0, planes=())
            for falloff in (None, 0.2, 0.5):
                cut = None if falloff is None else torch.full((count,), falloff)
                what = {"gaussians": count, "width": size[0], "height": size[1]}
                frames.append((what | {"falloff": falloff}, inputs, cut))
    return frames


@pytest.fixture
def exact(monkeypatch: pytest.MonkeyPatch) -> None:
    """A machine on which frames take exactly what PRICES say, on few small frames."""

    def timed(work: Any, device: Any) -> tuple[Any, float]:
        outputs = work()
        return outputs, Cost(PRICES).ms(work_of(outputs))

    monkeypatch.setattr(calibration, "timed", timed)
    monkeypatch.setattr(calibration, "frames", lambda device: few_frames())


def test_frames_outside_the_fit_tell_its_error(exact: None) -> None:
    found = calibration.calibrate(create_engine("cpu"), repeats=2)
    assert found.cost.error == pytest.approx(0, abs=1e-6)
    assert sum(frame["left_out"] for frame in found.frames) == len(found.frames) // 5
    for frame in found.frames:
        assert frame["predicted_ms"] == pytest.approx(frame["ms"], rel=1e-6)


def test_an_engine_that_does_not_count_its_lists_is_refused(exact: None) -> None:
    class Silent:
        name = "silent"

        def rasterize(self, inputs: Any, thresholds: Any) -> Any:
            from dataclasses import replace

            drawn = create_engine("cpu").rasterize(inputs, thresholds)
            return replace(drawn, entries_per_pixel=math.nan)

    with pytest.raises(CostError, match="list entries"):
        calibration.calibrate(Silent(), over=few_frames()[:1])


def test_prices_are_measured_once_and_kept(
    exact: None, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("FRAGPRUNE_CACHE", str(tmp_path))
    engine, said = create_engine("cpu"), []
    first = calibration.prices_of(engine, "cpu", say=said.append)
    assert calibration.prices_of(engine, "cpu", say=said.append) == first
    assert len(said) == 1
    assert calibration.kept_at(engine, "cpu").parent == tmp_path
    assert first.machine["threads"] == torch.get_num_threads()


GOOD = {"prices": PRICES, "error": 0.1, "machine": {}}


@pytest.mark.parametrize(
    ("text", "found"),
    [
        ("not json", "no prices"),
        ("[]", "list indices"),
        (json.dumps(GOOD | {"prices": {}}), "no 'frame'"),
        (json.dumps(GOOD | {"prices": PRICES | {"pixel": -1}}), "pixel at -1 ns"),
        (json.dumps(GOOD | {"prices": PRICES | {"entry": float("nan")}}), "entry at nan ns"),
        (json.dumps(GOOD | {"prices": PRICES | {"entry": None}}), "NoneType"),
        (json.dumps(GOOD | {"machine": 3}), "int"),
    ],
)
def test_a_malformed_file_is_a_stated_error(tmp_path: Path, text: str, found: str) -> None:
    file = tmp_path / "prices.json"
    file.write_text(text)
    with pytest.raises(CostError) as error:
        Cost.load(file)
    assert found in error.value.found
    assert "--calibrate" in error.value.remedy


def test_a_missing_file_is_one_too(tmp_path: Path) -> None:
    with pytest.raises(CostError, match="no such file"):
        Cost.load(tmp_path / "none.json")


def test_a_file_is_read_as_it_was_written(tmp_path: Path) -> None:
    cost = Cost(PRICES, 0.125, {"threads": 2})
    assert Cost.load(cost.save(tmp_path / "prices.json")) == cost
    unknown = Cost.load(Cost(PRICES).save(tmp_path / "other.json"))
    assert math.isnan(unknown.error)


def test_thresholds_shorten_a_frame_by_no_more_than_their_share():
    work = dict.fromkeys(UNITS, 1.0)
    cost = Cost(dict.fromkeys(UNITS, 1e6))  # six milliseconds, three of them by pairs
    assert cost.ms(work) == pytest.approx(6)
    assert cost.limit(work, 1.0) == pytest.approx(1)
    assert cost.limit(work, 3.0) == pytest.approx(6 / 4)
    assert cost.limit(work, math.inf) == pytest.approx(2)


def test_the_command_prints_and_keeps_prices(exact: None, tmp_path: Path) -> None:
    file = tmp_path / "prices.json"
    found = run_json("bench", "--calibrate", "--out", file, "--threads", 1)
    assert set(found) == {"prices", "error", "machine", "frames", "kept"}
    assert found["prices"] == Cost.load(file).prices
    assert found["kept"] == str(file)
    text = run("bench", "--calibrate", "--out", file, "--threads", 1).stdout
    assert "a list entry" in text
    assert "left out of the fit" in text


@pytest.mark.parametrize(
    "arguments",
    [("--calibrate", "--forward-only"), ("--calibrate", "--size", "9x9"), ("--out", "prices.json")],
)
def test_usage(arguments: tuple[str, ...]) -> None:
    assert run("bench", *arguments).exit_code == 2
