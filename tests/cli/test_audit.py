"""fragprune audit: a page, a JSON and maps from a model alone."""

import json
import re
from pathlib import Path

import numpy as np
import pytest
from cli.commands import fails, run_json, succeeds
from finetune import tiny
from PIL import Image

from fragprune_plugins.workbench.models.formats.ply import write_ply


@pytest.fixture(scope="module")
def model(tmp_path_factory):
    path = tmp_path_factory.mktemp("audit") / "model.ply"
    write_ply(path, tiny.random_model())
    return path


@pytest.fixture(scope="module")
def audited(model, tmp_path_factory):
    out = tmp_path_factory.mktemp("audited") / "out"
    words = ("--views", 3, "--resolution", 10)
    return out, run_json("audit", model, "--out", out, *words)


def test_one_page_and_one_json_of_a_model_alone(audited):
    out, report = audited
    saved = json.loads((out / "audit.json").read_text())
    assert saved == {key: value for key, value in report.items() if key != "page"}
    assert report["page"] == str(out / "audit.html")
    assert report["views"] == 3
    assert report["cameras"]["kind"] == "orbit"
    assert report["gaussians"] == 60
    first, *cuts = report["cuts"]
    assert first["psnr"] is None  # equal
    assert all(cut["psnr"] > 10 for cut in cuts)
    files = {file for view in report["maps"]["views"] for file in view["files"]}
    assert {path.name for path in out.iterdir()} == {"audit.html", "audit.json", *files}


def test_the_page_stands_alone_and_quotes_the_result(audited):
    out, report = audited
    page = (out / "audit.html").read_text()
    sources = re.findall(r'\b(?:src|href)="([^"]*)"', page)
    assert len(sources) == 4 * len(report["maps"]["views"])
    assert all(source.startswith("data:image/png;base64,") for source in sources)
    assert not re.search(r"https?:|url\(|@import", page)
    assert report["result"] in page
    assert report["cameras"]["why"] in page


def test_maps_have_the_views_pixels_and_one_scale(audited):
    out, report = audited
    limit = report["maps"]["limit"]
    for view in report["maps"]["views"]:
        means = []
        for file in view["files"]:
            with Image.open(out / file) as picture:
                assert picture.size == (80, 80)
                means.append(np.asarray(picture).mean())
        # indices into the colours are counts over the limit
        expected = [255 * view[key] / limit for key in ("fragments_per_pixel", "overdraw")]
        assert means[1:] == pytest.approx(expected, rel=0.05, abs=1)


def test_as_text_the_result_comes_first_and_tables_fit_a_terminal(model):
    result = succeeds("audit", model, "--views", 1, "--resolution", 16, "--orbit")
    first, *others = result.stdout.splitlines()
    assert re.match(r"60 Gaussians draw [\d.]+ fragments per pixel, [\d.]+ ms a frame", first)
    assert "a frame of 50x50 pixels" in first
    assert "1 generated view from all around" in first
    assert any(line.startswith("PlayCanvas ") for line in others)
    assert "fragprune finetune" in result.stdout
    titles = [line for line in others if line.endswith(":")]
    assert [title.split()[0] for title in titles] == ["Simple", "Pixels", "Where"]
    tables = [x.splitlines() for x in result.stdout.split("\n\n") if x.count("\n") > 2]
    assert max(len(line) for table in tables for line in table) <= 100
    assert {"Spark,", "Babylon.js", "GaussianSplatMesh"} <= set(result.stdout.split())
    assert "audit" in result.stderr  # the bar


def test_without_a_folder_there_is_the_table_alone(model, tmp_path, monkeypatch):
    """The command that it advises takes the photographs that it was given."""
    data = tiny.write_blender(tmp_path / "data", tiny.photographs(tiny.random_model()))
    (tmp_path / "here").mkdir()
    monkeypatch.chdir(tmp_path / "here")
    alone = run_json("audit", model, "--orbit", "--views", 1, "--resolution", 16)
    assert (alone["page"], alone["maps"]) == (None, None)
    assert f"finetune {model} --self --out pruned.ply. No photographs" in alone["pruning"]
    given = run_json("audit", model, "--data", data, "--views", 1)
    assert f"fragprune finetune {model} --data {data} --out pruned.ply." in given["pruning"]
    assert not list(Path().iterdir())


@pytest.mark.parametrize("write", [tiny.write_colmap, tiny.write_blender])
def test_a_scene_of_one_camera_serves_where_nothing_is_learned(model, tmp_path, write):
    data = write(tmp_path / "data", tiny.photographs(tiny.random_model()))
    if write is tiny.write_colmap:
        images = data / "sparse/0/images.txt"
        images.write_text("\n".join(images.read_text().splitlines()[-2:]) + "\n\n")
    else:
        for part, frames in (("train", 1), ("test", 0)):
            listed = json.loads((file := data / f"transforms_{part}.json").read_text())
            file.write_text(json.dumps(listed | {"frames": listed["frames"][:frames]}))
    report = run_json("audit", model, "--data", data)
    assert "1 of the 1 cameras" in report["cameras"]["why"]
    words = (model, "--self", "--data", data)
    assert run_json("profile", *words)["views"] == 1
    out = ("--iters", 1, "--out", tmp_path / "learned.ply")
    fails("finetune", *words, *out, says="no training view", code=1)
    if write is tiny.write_colmap:
        images.write_text("")
        fails("audit", model, "--data", data, says="at least one view", code=1)


@pytest.mark.parametrize(("divided", "width"), [(1, 1100), (4, 825)])
def test_the_cameras_of_its_training_are_taken_unless_others_are_asked_for(
    tmp_path, divided, width
):
    """At the size that they had there, but not too large."""
    given = {"resolution": divided}
    run = tiny.host_output(tmp_path / "run", tmp_path / "scene", tiny.random_model(), **given)
    camera, *_ = json.loads((run / "cameras.json").read_text())
    camera |= {"width": 3300, "height": 33, "fx": 3000.0, "fy": 3000.0}
    (run / "cameras.json").write_text(json.dumps([camera]))
    out = ("--out", tmp_path / "out")
    report = run_json("audit", run, *out)
    assert report["cameras"]["kind"] == "given"
    assert report["maps"]["views"][0]["width"] == width  # of 3300
    asked = run_json("audit", run, "--resolution", 2, *out)
    assert asked["maps"]["views"][0]["width"] == 1650
    for side in ("orbit", "inside"):
        asked = run_json("audit", run, f"--{side}", "--views", 1, "--resolution", 16, *out)
        assert asked["cameras"]["kind"] == side
    cameras = tiny.write_path(tmp_path / "cameras.json", tiny.NAMES[:7], tiny.SIDE, tiny.SIDE)
    report = run_json("audit", run, "--cameras", cameras, "--views", 3, *out)
    assert "3 of the 7 cameras" in report["cameras"]["why"]
    assert {view["width"] for view in report["maps"]["views"]} == {tiny.SIDE}


def test_a_pruned_model_says_what_its_thresholds_save(tmp_path):
    path = tmp_path / "pruned.ply"
    write_ply(path, tiny.cut(tiny.random_model(), 0.3))
    words = ("audit", path, "--views", 1, "--resolution", 16)
    report, plain = run_json(*words), run_json(*words, "--no-truncation")
    assert (report["truncated"], plain["truncated"]) == (True, False)
    saved = r"has cutoffs. With them it draws \d\.\d\dx fewer fragments"
    assert re.search(saved, report["pruning"])
    assert plain["fragments_per_pixel"] == report["cuts"][-1]["fragments_per_pixel"]
