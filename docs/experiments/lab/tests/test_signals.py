"""Signals are fitted each by itself, and truncation makes edges."""

from __future__ import annotations

import json

import pytest
import torch
from cli.commands import run, run_json
from lab import signals
from lab.signals import LINES, PICTURES, fit
from PIL import Image

from fragprune_plugins.engines import create_engine

ENGINE = create_engine("auto")
HOW = {"iterations": 4, "engine": ENGINE}


@pytest.mark.parametrize(
    ("layout", "made"), [(LINES, signals.lines()), (PICTURES, signals.pictures())]
)
def test_signals_fill_their_layout(layout, made):
    for signal in made.values():
        assert signal.shape == (layout.height, layout.width, 3)
        assert 0 <= signal.min() < signal.max() <= 1


@pytest.mark.parametrize("layout", [LINES, PICTURES])
def test_as_many_parameters(layout):
    for count in layout.counts:
        assert layout.equal(count) * layout.parameters == count * (layout.parameters + 1)


@pytest.mark.parametrize("truncated", [False, True])
@pytest.mark.parametrize("layout", [LINES, PICTURES])
def test_signals_that_are_fitted_together_do_not_touch(layout, truncated):
    stream = torch.Generator().manual_seed(0)
    one, two, other = torch.rand(3, layout.height, layout.width, 3, generator=stream)
    if layout is LINES:
        one, two, other = (
            line.mean(-1, keepdim=True).expand(line.shape) for line in (one, two, other)
        )
    first = fit(layout, torch.stack([one, two]), 6, (0, 1), truncated=truncated, **HOW)
    second = fit(layout, torch.stack([one, other]), 6, (0, 1), truncated=truncated, **HOW)
    assert torch.equal(first.fitted[:, 0], second.fitted[:, 0])
    assert not torch.equal(first.fitted[:, 1], second.fitted[:, 1])
    assert torch.equal(first.errors[:, :, 0], second.errors[:, :, 0])


def test_errors_are_of_every_other_pixel():
    target = torch.rand(1, 1, LINES.width, 1).expand(1, 1, LINES.width, 3)
    done = fit(LINES, target, 3, (0,), truncated=False, **HOW)
    squared = (done.fitted[0, 0, 0, :, 0].clamp(0, 1) - target[0, 0, :, 0]).square()
    torch.testing.assert_close(done.errors[0, 0, 0], squared[1::2].mean())
    torch.testing.assert_close(done.errors[1, 0, 0], squared[::2].mean())


@pytest.mark.parametrize("truncated", [False, True])
def test_thresholds_open_half_way(truncated):
    opened = []

    class Watched:
        name = "watched"

        def rasterize(self, inputs, thresholds):
            opened.append(thresholds is not None)
            return ENGINE.rasterize(inputs, thresholds)

    target = torch.rand(1, 1, LINES.width, 1).expand(1, 1, LINES.width, 3)
    fit(LINES, target, 3, (0,), truncated=truncated, iterations=6, engine=Watched())
    assert opened == [False] * 3 + [truncated] * (3 + 1)  # the last one draws what was fitted


@pytest.fixture
def few(monkeypatch):
    monkeypatch.setattr(signals, "LINES", signals.Layout("lines", 1, signals.LENGTH, 4, (4,), 4))
    side = signals.SIDE
    monkeypatch.setattr(signals, "PICTURES", signals.Layout("pictures", side, side, 9, (9,), 9))


def test_the_command_needs_no_model(few, tmp_path):
    words = ["experiment", "signals", "--out", tmp_path, "--iters", 2, "--seeds", "0,1"]
    report = run_json(*words)
    assert len(report["rows"]) == 3 * (len(signals.lines()) + len(signals.pictures()))
    assert {row["parameters"] for row in report["rows"]} == {16, 20, 81, 90}
    with Image.open(tmp_path / "signals.png") as picture:
        assert len(picture.convert("RGB").getcolors(1 << 24)) > 50
    kept = {file: file.stat().st_mtime_ns for file in (tmp_path / "arms").iterdir()}
    assert run_json(*words) == report
    assert kept == {file: file.stat().st_mtime_ns for file in (tmp_path / "arms").iterdir()}
    assert json.loads((tmp_path / "signals.json").read_text())["seeds"] == [0, 1]
    refused = run(*words[:-3], 3, *words[-2:])
    assert refused.exit_code == 1
    assert "iterations was 2 and is 3" in refused.stderr
