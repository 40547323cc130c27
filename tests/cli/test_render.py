"""fragprune render."""

import json

import pytest
from cli.commands import fails, run, run_json
from finetune import tiny
from finetune.several import command
from PIL import Image


def test_held_out_views(cut_scene, tmp_path):
    data, path = cut_scene
    out = tmp_path / "pictures"
    report = run_json("render", path, "--data", data, "--out", out)
    names = sorted(file.name for file in out.iterdir())
    assert names == ["view00.png", "view08.png"]
    assert len(report["files"]) == 2
    with Image.open(out / "view00.png") as picture:
        assert picture.size == (tiny.SIDE, tiny.SIDE)
    plain = run_json("render", path, "--data", data, "--out", out, "--no-truncation")
    assert plain["truncated"] is False
    assert report["truncated"] is True
    assert plain["fragments_per_pixel"] > report["fragments_per_pixel"]


@pytest.mark.parametrize("size", [2, 3])
def test_gaussians_divided_among_processes_give_the_same_pictures(cut_scene, tmp_path, size):
    data, path = cut_scene
    words = ("render", path, "--data", data, "--out")
    one, many = tmp_path / "one", tmp_path / "many"
    whole = run_json(*words, one)
    first, *others = command(size, *words, many, "--shard-gaussians", "--json")
    assert [each.left for each in others] == [(0, "", "")] * (size - 1)
    report = json.loads(first.left[1])
    files = {file.name: file.read_bytes() for file in one.iterdir()}
    assert {file.name: file.read_bytes() for file in many.iterdir()} == files
    assert sorted(report["files"]) == sorted(str(many / name) for name in files)
    for name in ("fragments_per_pixel", "gaussians", "truncated", "warnings"):
        assert report[name] == pytest.approx(whole[name]), name


def test_a_film_is_not_drawn_by_several_processes(cut_scene, tmp_path):
    data, path = cut_scene
    film = tmp_path / "film.mp4"
    ended = command(2, "render", path, "--data", data, "--out", film, "--shard-gaussians")
    assert [each.left[0] for each in ended] == [2, 2]
    asked = ("render", path, "--data", data, "--out", tmp_path / "p", "--shard-gaussians")
    fails(*asked, says="torchrun")


def test_cameras_file_and_views(cut_scene, tmp_path):
    data, path = cut_scene
    cameras = tiny.write_path(tmp_path / "path.json", ["a", "b"])
    out = tmp_path / "pictures"
    result = run("render", path, "--cameras", cameras, "--out", out)
    assert result.exit_code == 0
    assert "Wrote 2 pictures" in result.stdout
    with Image.open(out / "b.png") as picture:
        assert picture.size == (20, 12)
    report = run_json("render", path, "--data", data, "--views", "all", "--out", out)
    assert len(report["files"]) == 9


def test_two_views_of_one_name_are_two_pictures(cut_scene, tmp_path):
    _, path = cut_scene
    cameras = tiny.write_path(tmp_path / "path.json", ["train/r_0", "test/r_0"])
    out = tmp_path / "pictures"
    report = run_json("render", path, "--cameras", cameras, "--out", out)
    assert sorted(file.name for file in out.iterdir()) == ["r_0-2.png", "r_0.png"]
    assert len(set(report["files"])) == 2
    assert report["warnings"] == []


def test_a_view_that_shows_nothing_is_warned_of(cut_scene, tmp_path):
    _, path = cut_scene
    content = tiny.transforms(["a", "b"], tiny.cameras()[:2]) | {"w": 20, "h": 12}
    content["frames"][1]["transform_matrix"][2][3] = 1e5
    (tmp_path / "path.json").write_text(json.dumps(content))
    words = ("render", path, "--cameras", tmp_path / "path.json", "--out", tmp_path / "pictures")
    assert "Warning: 1 of 2 show no Gaussian" in run(*words).stdout
    assert len(run_json(*words)["warnings"]) == 1
