"""``fragprune bench``: its JSON shape, its options, a model of one's own."""

from pathlib import Path

import pytest
from cli.commands import run, run_json, succeeds
from finetune import tiny

from fragprune_plugins.workbench.bench import timing, work
from fragprune_plugins.workbench.models.formats.ply import write_ply

SMALL = ("--size", "40x30", "--gaussians", 200)


@pytest.fixture(autouse=True)
def two_rounds(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(work, "REPEATS", 2)


def test_json_shape() -> None:
    found = run_json("bench", *SMALL, "--threads", 1)
    parts = {"results", "saved", "machine"}
    assert set(found) == parts
    assert len(found["results"]) == 4
    assert {row["scene"] for row in found["results"]} == {"bench-200"}
    assert {row["threads"] for row in found["results"]} == {1}
    assert set(found["saved"]) == {"bench-200 40x30"}
    assert set(found["saved"]["bench-200 40x30"]) == {"fragments", "time", "share"}
    assert set(found["machine"]) == {
        *("processor", "cores", "load_before", "load_after", "platform", "torch", "native", "gpu")
    }


def test_every_size_and_count() -> None:
    sizes = ("--size", "24x16", "--size", "33x17")
    counts = ("--gaussians", 50, "--gaussians", 120)
    found = run_json("bench", *sizes, *counts)
    assert len(found["results"]) == 2 * 2 * 2 * 2
    assert len(found["saved"]) == 4
    forward = [row for row in found["results"] if row["pass"] == "forward"]
    plain = [row for row in forward if not row["truncated"]]
    prices = [
        1e6 * row["ms_median"] / (row["fragments_per_pixel"] * row["width"] * row["height"])
        for row in plain
    ]
    assert [row["ns_per_fragment"] for row in plain] == pytest.approx(prices)


def test_the_text_says_what_was_saved_and_how_busy_the_machine_was() -> None:
    said = succeeds("bench", *SMALL)
    assert "x fewer fragments" in said.stdout
    assert "load" in said.stdout.splitlines()[-1]
    assert "round 2 of 2" in said.stderr


@pytest.mark.parametrize("learned", [False, True])
def test_a_model_of_ones_own_with_its_thresholds(tmp_path: Path, learned: bool) -> None:
    model = tmp_path / "mine.ply"
    splat = tiny.random_model()
    write_ply(model, tiny.cut(splat, 0.5) if learned else splat)
    cameras = tiny.write_path(tmp_path / "cameras.json", ["a"])
    rows = run_json("bench", model, "--cameras", cameras, "--size", "32x32")["results"]
    assert [(row["scene"], row["gaussians"]) for row in rows] == [("mine", 60)] * 4
    plain, cut = (row["fragments_per_pixel"] for row in rows if row["pass"] == "forward")
    assert plain > cut > 0
    assert (cut < 0.5 * plain) == learned
    assert timing.TRUNCATION < 0.1


def test_a_system_without_a_load_average(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.delattr("os.getloadavg")
    assert "load unknown" in run("bench", *SMALL).stdout
