"""fragprune view."""

import json
import shutil
import urllib.request
from threading import Thread

import pytest
from cli.commands import fails, run_json
from finetune import tiny

from fragprune_plugins.workbench.figures import records
from fragprune_plugins.workbench.models.formats.ply import write_ply
from fragprune_plugins.workbench.view import site as serving


def test_a_folder_with_cameras_and_photographs(cut_scene, tmp_path):
    data, path = cut_scene
    out = tmp_path / "page"
    report = run_json("view", path, "--data", data, "--out", out)
    held = json.loads((out / "scene.json").read_text())
    assert [each["name"] for each in held["layers"]] == ["No cutoffs", "Pruned"]
    assert [each["name"] for each in held["cameras"]] == ["view00.png", "view08.png"]
    assert all((out / each["photograph"]).exists() for each in held["cameras"])
    assert held["start"]["position"] == held["cameras"][0]["position"]
    assert sorted(report["files"]) == sorted(str(p) for p in out.rglob("*.*"))
    assert report["truncated"] == [True]
    assert "positions" in report["rounded"]
    assert all("bits" in each for each in held["models"])


@pytest.mark.parametrize("name", [".", "index.html"])
def test_a_page_of_somebody_else_is_not_overwritten(cut_scene, tmp_path, name):
    _, path = cut_scene
    (tmp_path / "page").mkdir()
    run_json("view", path, "--out", tmp_path / "page" / name)
    run_json("view", path, "--out", tmp_path / "page" / name)  # our own may be
    own = tmp_path / "website" / "index.html"
    own.parent.mkdir()
    own.write_text("<!doctype html><title>My site</title>")
    says = ("did not write", "Choose another --out, or delete the page.")
    fails("view", path, "--out", own.parent / name, says=says, code=1)
    assert own.read_text().endswith("My site</title>")
    assert list(own.parent.iterdir()) == [own]


def test_two_models_are_two_sides(cut_scene, tmp_path):
    _, path = cut_scene
    other = tmp_path / "other.ply"
    write_ply(other, tiny.random_model(20))
    report = run_json("view", path, other, "--out", tmp_path / "page")
    held = json.loads((tmp_path / "page" / "scene.json").read_text())
    assert [each["model"] for each in held["layers"]] == [0, 1]
    sides = [(each["name"], each["truncated"]) for each in held["layers"]]
    assert sides == [("Original", False), ("Pruned", True)]
    assert report["gaussians"] == [20, 60]


def test_two_models_of_one_file_name_are_told_apart(tmp_path):
    """As hosts name theirs: by the folder, and not by the end of a long path that is cut off."""
    words = []
    for number in (7, 9):
        folder = tmp_path / "out" / "point_cloud" / f"iteration_{number}"
        folder.mkdir(parents=True)
        write_ply(folder / "point_cloud.ply", tiny.random_model(20))
        words.append(folder / "point_cloud.ply")
    run_json("view", *words, "--out", tmp_path / "page")
    held = json.loads((tmp_path / "page" / "scene.json").read_text())
    assert [each["name"] for each in held["layers"]] == ["iteration_7", "iteration_9"]


@pytest.mark.parametrize("there", [True, False])
def test_the_original_that_a_record_names_stands_left_if_it_lies_in_the_same_folder(
    cut_scene, tmp_path, there
):
    pruned = tmp_path / "pruned.ply"
    shutil.copy(cut_scene[1], pruned)
    original = (tmp_path if there else tmp_path.parent) / "before.ply"
    write_ply(original, tiny.random_model(20))
    records.leave(pruned, "finetune", {"model": str(original), "out": str(pruned)})
    report = run_json("view", pruned, "--out", tmp_path / "page")
    held = json.loads((tmp_path / "page" / "scene.json").read_text())
    names = ["Original", "Pruned"] if there else ["No cutoffs", "Pruned"]
    assert [each["name"] for each in held["layers"]] == names
    assert report["compare"] == (str(original) if there else None)


def test_the_cameras_of_a_training_are_found(cut_scene, tmp_path):
    _, path = cut_scene
    place = tmp_path / "out" / "point_cloud" / "iteration_7"
    place.mkdir(parents=True)
    path.rename(place / "point_cloud.ply")
    camera = {
        **{"id": 0, "img_name": "a", "width": 20, "height": 10, "fx": 9.0, "fy": 9.0},
        **{"position": [0, 0, -3], "rotation": [[1, 0, 0], [0, 1, 0], [0, 0, 1]]},
    }
    (tmp_path / "out" / "cameras.json").write_text(json.dumps([camera]))
    (tmp_path / "out" / "cfg_args").write_text("Namespace()")
    assert run_json("view", tmp_path / "out", "--out", tmp_path / "page")["cameras"] == 1
    held = json.loads((tmp_path / "page" / "scene.json").read_text())
    assert held["start"]["position"] == [0, 0, -3]


def test_one_page(cut_scene, tmp_path):
    report = run_json("view", cut_scene[1], "--out", tmp_path / "pages" / "mine.html")
    assert report["files"] == [str(tmp_path / "pages" / "mine.html")]
    assert [each.name for each in (tmp_path / "pages").iterdir()] == ["mine.html"]


def test_serves_until_ctrl_c(cut_scene, monkeypatch):
    opened = []

    def serve(server):
        def fetch():
            with urllib.request.urlopen(serving.address(server)) as answer:
                opened.append(answer.read())

        reader = Thread(target=fetch)
        reader.start()
        server.handle_request()
        reader.join()
        raise KeyboardInterrupt

    monkeypatch.setattr(serving.ThreadingHTTPServer, "serve_forever", serve)
    monkeypatch.setattr("webbrowser.open", opened.append)
    report = run_json("view", cut_scene[1])
    assert opened[0] == report["address"]
    assert b"<title>" in opened[1]
    report = run_json("view", cut_scene[1], "--no-browser")
    assert len(opened) == 3
