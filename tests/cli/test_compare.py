"""fragprune compare and profile."""

import json
from dataclasses import replace
from pathlib import Path

import pytest
import torch
from cli.commands import run, run_json
from finetune import tiny
from PIL import Image

from fragprune_plugins import RasterInputs, load_cameras, rasterize
from fragprune_plugins.workbench.figures import evaluate
from fragprune_plugins.workbench.figures.metrics import psnr
from fragprune_plugins.workbench.models.formats.arrays import SH_C0
from fragprune_plugins.workbench.models.formats.ply import write_ply

FIGURES = ("psnr", "ssim", "fragments_per_pixel", "gaussians")


@pytest.fixture
def other(model, tmp_path):
    """The same Gaussians with thresholds."""
    write_ply(tmp_path / "other.ply", tiny.cut(model, 0.3))
    return tmp_path / "other.ply"


def test_two_models(data, path, other, tmp_path):
    report = run_json("compare", path, other, "--data", data, "--out", tmp_path / "pictures")
    assert report["speedup"] > 1.2
    assert report["a"]["model"] == str(path)
    assert report["b"]["psnr"] - report["a"]["psnr"] == report["psnr_change"]
    assert len(report["files"]) == 2
    text = run("compare", path, other, "--data", data).stdout
    assert "B against A: " in text
    assert "x fewer fragments" in text


@pytest.mark.parametrize(("silent", "shows"), [(0, True), (100, False)])
def test_a_long_measurement_shows_how_far_it_is(data, path, monkeypatch, silent, shows):
    monkeypatch.setattr(evaluate, "SILENT", silent)
    result = run("compare", path, path, "--data", data)
    for words in ("measuring:", "timing frames:"):
        assert (words in result.stderr) is shows
        assert words not in result.stdout


def test_a_model_of_which_nothing_is_seen_has_no_speedup(data, path, model, tmp_path):
    away = tmp_path / "away.ply"
    write_ply(away, replace(model, xyz=model.xyz + 1e4))
    report = run_json("compare", path, away, "--data", data)
    assert report["b"]["fragments_per_pixel"] == 0
    assert report["speedup"] is None
    text = run("compare", path, away, "--data", data).stdout
    assert "B against A: no fragments (" in text


def test_frames_are_timed_at_another_size(data, path, tmp_path, monkeypatch):
    """Quality and fragments stay those of the photographs' size."""
    plain = run_json("compare", path, path, "--data", data)
    sizes = []

    def frame_times(candidates, views, engine, *, repeats):
        sizes.extend((view.width, view.height) for view in views)
        return [{"frame_ms": 1.0, "frame_ms_se": 0.0} for _ in candidates]

    monkeypatch.setattr(evaluate, "frame_times", frame_times)
    report = run_json("compare", path, path, "--data", data, "--enlarge", 3)
    assert set(sizes) == {(3 * tiny.SIDE, 3 * tiny.SIDE)}
    assert [report["a"][key] for key in FIGURES] == [plain["a"][key] for key in FIGURES]
    text = run("compare", path, path, "--data", data, "--enlarge", 3).stdout
    assert "Frames of 96x96 pixels." in text
    assert ", frames of 3x the size 1.00 -> 1.00 ms (" in text
    run_json("compare", path, path, "--data", data, "--enlarge", 3, "--out", tmp_path / "out")
    assert ", frames of 3x the size 1.00 -> " in run_json("report", tmp_path / "out")["result"]


def test_views_of_several_sizes_are_not_said_to_have_one(data, path):
    _, held_out = sorted((data / "images").iterdir())[::8]
    with Image.open(held_out) as picture:
        picture.resize((2 * tiny.SIDE, 2 * tiny.SIDE)).save(held_out)
    text = run("compare", path, path, "--data", data, "--enlarge", 2).stdout
    assert ", 32x32 to 64x64 pixels" in text
    assert "Frames of 64x64 to 128x128 pixels." in text


def test_without_photographs_b_is_compared_with_what_a_shows(path, model, other, tmp_path):
    """Drawn here by hand: PSNR of B's pictures against A's, from the held-out cameras."""
    cameras = tiny.write_path(tmp_path / "path.json", [f"v{i}" for i in range(9)], 24, 16)
    report = run_json("compare", path, other, "--cameras", cameras)
    views = [view for name, view in load_cameras(cameras) if name in ("v0", "v8")]
    thresholds = torch.full((len(model),), 0.3)
    pictures = [
        [rasterize(RasterInputs(view, model.splats()), cut).image for cut in (None, thresholds)]
        for view in views
    ]
    expected = [psnr(after, before) for before, after in pictures]
    assert report["target"] == "itself"
    assert report["a"]["psnr"] is None  # infinite
    assert report["b"]["psnr"] == pytest.approx(sum(expected) / 2, abs=0.01)
    assert "PSNR against itself" in run("compare", path, other, "--cameras", cameras).stdout


def test_what_finetune_self_wrote_is_compared_with_what_came_in(path, tmp_path):
    """The figures are those that finetune gave."""
    other = tmp_path / "other.ply"
    words = ("--self", "--resolution", 16, "--iters", 5)
    learned = run_json("finetune", path, *words, "--out", other)
    report = run_json("compare", path, other)
    assert (report["target"], report["b"]["views"]) == ("itself", 12)
    for key in FIGURES:
        assert report["b"][key] == pytest.approx(learned["after"][key], rel=1e-5), key


def test_a_camera_that_sees_nothing_tells_nothing_of_a_model(path, model, tmp_path):
    """A picture of one colour equals what it shows, and the colour."""
    write_ply(path, tiny.cut(model, 0.1))
    away, *others = tiny.host_cameras(tiny.cameras())
    cameras = tmp_path / "cameras.json"
    cameras.write_text(json.dumps([away | {"position": [0, 0, 50]}, *others]))
    report = run_json("profile", path, "--cameras", cameras)
    assert report["warnings"] == []
    cameras.write_text(json.dumps(others[-1:] + others))
    assert report["psnr"] == pytest.approx(run_json("profile", path, "--cameras", cameras)["psnr"])


def test_a_model_that_shows_other_things_is_told(data, path, model, tmp_path):
    """Also where dark pictures make its PSNR a high one."""
    near = tmp_path / "near.ply"
    write_ply(near, tiny.cut(model, 0.2))
    assert run_json("compare", path, near, "--data", data)["warnings"] == []
    assert run_json("profile", near, "--data", data)["warnings"] == []
    for image in (data / "images").iterdir():
        with Image.open(image) as picture:
            picture.point(lambda level: level // 4).save(image)
    dark, moved = tmp_path / "dark.ply", tmp_path / "moved.ply"
    colour = (0.5 + SH_C0 * model.f_dc) / 4
    model = replace(model, f_dc=(colour - 0.5) / SH_C0, f_rest=model.f_rest / 4)
    write_ply(dark, model)
    write_ply(moved, replace(model, xyz=model.xyz + torch.tensor([1.0, 0.0, 0.0])))
    report = run_json("compare", dark, moved, "--data", data)
    (warning,) = report["warnings"]
    assert warning.startswith("B hardly shows these pictures")
    assert report["b"]["psnr"] > 20
    assert run_json("profile", dark, "--data", data)["warnings"] == []
    (warning,) = run_json("profile", moved, "--data", data)["warnings"]
    assert warning.startswith("MODEL hardly shows these pictures")


def test_profile_has_a_column_with_thresholds_and_one_without(data, path, model, tmp_path):
    plain = run_json("profile", path, "--data", data)
    assert plain["truncated"] is False
    assert list(plain["columns"]) == ["untruncated"]
    write_ply(path, tiny.cut(model, 0.3))
    report = run_json("profile", path, "--data", data, "--out", tmp_path / "pictures")
    assert list(report["columns"]) == ["untruncated", "truncated"]
    assert report["fragments_per_pixel"] == report["columns"]["truncated"]["fragments_per_pixel"]
    assert report["fragments_per_pixel"] < plain["fragments_per_pixel"]
    assert len(report["threshold_quantiles"]) == 5
    assert len(list((tmp_path / "pictures").glob("*.png"))) == len(report["files"]) == 2
    text = run("profile", path, "--data", data, "--views", "train").stdout
    assert "7 views" in text
    assert "fragments per pixel" in text
    words = ("--orbit", "--resolution", 16, "--out", tmp_path / "own")  # against its own pictures
    report = run_json("profile", path, *words)
    assert (report["target"], report["columns"]["untruncated"]["psnr"]) == ("itself", None)
    assert run_json("report", tmp_path / "own")["command"] == "profile"
    assert 10 < report["psnr"] < 80


def test_profile_measures_a_stop_without_cutoffs(data, path, model, tmp_path):
    stopping = tmp_path / "stopping.ply"
    write_ply(stopping, model.with_rules(stop=0.3))
    report = run_json("profile", stopping, "--data", data, "--out", tmp_path / "pictures")
    without, having = (report["columns"][key] for key in ("untruncated", "truncated"))
    assert report["fragments_per_pixel"] == having["fragments_per_pixel"]
    assert having["fragments_per_pixel"] < without["fragments_per_pixel"]
    assert "with its stop" in run("profile", stopping, "--data", data).stdout
    page = run_json("report", tmp_path / "pictures")["page"]
    assert "with its stop" in Path(page).read_text(encoding="utf-8")
