"""fragprune compare."""

from __future__ import annotations

import importlib

from cli.commands import run, run_json
from finetune import tiny

from fragprune_plugins.files.ply import write_ply

FIGURES = ("psnr", "ssim", "fragments_per_pixel", "gaussians")


def test_two_models(tmp_path):
    data, path, model = tiny.scene(tmp_path)
    other = tmp_path / "other.ply"
    write_ply(other, tiny.cut(model, 0.3))
    report = run_json("compare", path, other, "--data", data, "--out", tmp_path / "pictures")
    assert report["speedup"] > 1.2
    assert report["a"]["model"] == str(path)
    assert report["b"]["psnr"] - report["a"]["psnr"] == report["psnr_change"]
    assert len(report["files"]) == 2
    text = run("compare", path, other, "--data", data).stdout
    assert "B against A: " in text
    assert "x fewer fragments" in text


def test_equal_models_have_finite_json(tmp_path):
    """A perfect render has infinite PSNR, which JSON cannot say."""
    data, path, _ = tiny.scene(tmp_path)
    report = run_json("compare", path, path, "--data", data)
    assert report["psnr_change"] == 0
    assert report["speedup"] == 1


def test_frames_are_timed_at_another_size(tmp_path, monkeypatch):
    """Quality and fragments stay those of the photographs' size."""
    data, path, _ = tiny.scene(tmp_path)
    plain = run_json("compare", path, path, "--data", data)
    sizes = []

    def frame_times(candidates, views, engine, *, repeats):
        sizes.extend((view.width, view.height) for view in views)
        return [{"frame_ms": 1.0, "frame_ms_se": 0.0} for _ in candidates]

    module = importlib.import_module("fragprune_plugins.workbench.figures.evaluate")
    monkeypatch.setattr(module, "frame_times", frame_times)
    report = run_json("compare", path, path, "--data", data, "--enlarge", 3)
    assert set(sizes) == {(3 * tiny.SIDE, 3 * tiny.SIDE)}
    assert [report["a"][key] for key in FIGURES] == [plain["a"][key] for key in FIGURES]
    text = run("compare", path, path, "--data", data, "--enlarge", 3).stdout
    assert "Frames of 96x96 pixels." in text
