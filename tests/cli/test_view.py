"""fragprune view."""

import json
import shlex
import urllib.request
from threading import Thread

import pytest
from cli.commands import fails, run, run_json
from finetune import tiny

from fragprune_plugins.workbench.figures import records
from fragprune_plugins.workbench.models.formats.ply import write_ply
from fragprune_plugins.workbench.view import site as serving


@pytest.fixture
def page(tmp_path):
    """Writes a page; what the command says, and what the page shows."""

    def written(*words):
        report = run_json("view", *words, "--out", tmp_path / "page")
        return report, json.loads((tmp_path / "page" / "scene.json").read_text())

    return written


def test_a_folder_with_cameras_and_photographs(data, cut, page, tmp_path):
    report, held = page(cut, "--data", data)
    out = tmp_path / "page"
    assert [each["name"] for each in held["layers"]] == ["No cutoffs", "Pruned"]
    assert [each["name"] for each in held["cameras"]] == ["view00.png", "view08.png"]
    assert all((out / each["photograph"]).exists() for each in held["cameras"])
    assert held["start"]["position"] == held["cameras"][0]["position"]
    assert sorted(report["files"]) == sorted(str(p) for p in out.rglob("*.*"))
    assert report["truncated"] == [True]
    assert "positions" in report["rounded"]
    assert all("bits" in each for each in held["models"])


def test_the_command_that_serves_a_page_is_one_to_copy(cut, tmp_path):
    out = tmp_path / "my page"
    said = run("view", cut, "--out", out).stdout
    assert f"http.server -d {shlex.quote(str(out))}" in said


@pytest.mark.parametrize("name", [".", "index.html"])
def test_a_page_of_somebody_else_is_not_overwritten(cut, tmp_path, name):
    (tmp_path / "page").mkdir()
    for _ in range(2):  # our own may be
        run_json("view", cut, "--out", tmp_path / "page" / name)
    own = tmp_path / "website" / "index.html"
    own.parent.mkdir()
    own.write_text("<!doctype html><title>My site</title>")
    says = ("did not write", "Choose another --out, or delete the page.")
    fails("view", cut, "--out", own.parent / name, says=says, code=1)
    assert own.read_text().endswith("My site</title>")
    assert list(own.parent.iterdir()) == [own]


def test_two_models_are_two_sides(cut, page, tmp_path):
    other = tmp_path / "other.ply"
    write_ply(other, tiny.random_model(20))
    report, held = page(cut, other)
    assert [each["model"] for each in held["layers"]] == [0, 1]
    sides = [(each["name"], each["truncated"]) for each in held["layers"]]
    assert sides == [("Original", False), ("Pruned", True)]
    assert report["gaussians"] == [20, 60]


def test_two_models_of_one_file_name_are_told_apart(data, model, page):
    """As hosts name theirs: by the folder, and not by the end of a long path that is cut off."""
    models = sorted(tiny.host_output(data.parent / "out", data, model).rglob("*.ply"))
    names = [each["name"] for each in page(*models)[1]["layers"]]
    assert names == ["iteration_10000", "iteration_900"]


@pytest.mark.parametrize("there", [True, False])
def test_the_original_of_a_record_stands_left_if_it_lies_beside(cut, page, tmp_path, there):
    original = (tmp_path if there else tmp_path.parent) / "before.ply"
    write_ply(original, tiny.random_model(20))
    records.leave(cut, "finetune", {"model": str(original), "out": str(cut)})
    report, held = page(cut)
    names = ["Original", "Pruned"] if there else ["No cutoffs", "Pruned"]
    assert [each["name"] for each in held["layers"]] == names
    assert report["compare"] == (str(original) if there else None)


def test_the_cameras_of_a_training_are_found(data, model, page):
    report, held = page(tiny.host_output(data.parent / "out", data, model))
    assert report["cameras"] == 9
    expected = tiny.host_cameras(tiny.cameras()[:1])[0]["position"]
    assert held["start"]["position"] == pytest.approx(expected)


def test_one_page(cut, tmp_path):
    for name in ("mine.htm", "pages/mine.html"):
        files = run_json("view", cut, "--out", tmp_path / name)["files"]
        assert files == [str(tmp_path / name)]
    assert [each.name for each in (tmp_path / "pages").iterdir()] == ["mine.html"]


def test_serves_until_ctrl_c(cut, monkeypatch):
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
    report = run_json("view", cut)
    assert opened[0] == report["address"]
    assert b"<title>" in opened[1]
    report = run_json("view", cut, "--no-browser")
    assert len(opened) == 3
