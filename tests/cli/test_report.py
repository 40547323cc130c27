"""``fragprune report``: one page from what commands leave beside their results."""

import base64
import json
import re
import shutil
import sys
from dataclasses import replace

import pytest
import torch
from cli.commands import run, run_error, run_json, succeeds
from finetune import tiny

import fragprune_plugins as fp
from fragprune_plugins import Model, load
from fragprune_plugins.workbench.figures import records
from fragprune_plugins.workbench.report import page as report_page
from fragprune_plugins.workbench.scenes.generated import around, bounds


@pytest.fixture(scope="module")
def finetuned(tmp_path_factory):
    """A folder with all that a fine-tuning takes and leaves, and its figures."""
    folder = tmp_path_factory.mktemp("report")
    data, model, _ = tiny.scene(folder)
    words = ("--data", data, "--iters", 4, "--train", "opacity")
    return folder, run_json("finetune", model, "--out", folder / "out" / "pruned.ply", *words)


@pytest.fixture(scope="module", autouse=True)
def _curves_once():
    """The same curves are drawn once, which takes half a second."""
    draw, drawn = report_page.save_learning, {}

    def given(path, curves, thresholds):
        kind = thresholds is None, repr(curves)
        if kind not in drawn:
            draw(path, curves, thresholds)
            drawn[kind] = path.read_bytes()
        path.write_bytes(drawn[kind])

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(report_page, "save_learning", given)
        yield


@pytest.fixture
def out(finetuned, tmp_path):
    """What it left, in a copy of that folder: a record names files beside its own."""
    return shutil.copytree(finetuned[0], tmp_path / "all") / "out"


@pytest.fixture
def data(out):
    return out.parent / "data"


@pytest.fixture
def record(out):
    (record,) = records.find(out)
    return record


def test_a_fine_tuning_becomes_a_page_that_stands_alone(finetuned, out, data):
    _, figures = finetuned
    report = run_json("report", out, "--data", data)
    page = (out / "report.html").read_text()
    assert report["page"] == str(out / "report.html")
    assert report["before"] == figures["before"]
    assert report["after"] == figures["after"]
    assert report["command"] == "finetune"
    fewer = figures["before"]["fragments_per_pixel"] / figures["after"]["fragments_per_pixel"]
    assert f"{fewer:.2f}x fewer fragments" in report["result"]
    assert "<title>Pruning of model.ply" in page
    assert report["result"].replace(">", "&gt;") in page
    assert len(report["views"]) > 0
    # every picture is in the page itself: seven a view and the curves
    assert page.count('src="data:image/png;base64,') == report["pictures"]
    assert report["pictures"] == 7 * len(report["views"]) + 1
    assert page.count("src=") == report["pictures"]
    assert "://" not in page


def test_a_fine_tuning_without_photographs_shows_the_original_s_own_views(path, tmp_path):
    out = tmp_path / "pruned.ply"
    words = ("--iters", 2, "--train", "opacity", "--resolution", 16)
    run_json("finetune", path, "--self", "--out", out, *words)
    report = run_json("report", tmp_path)
    splat = load(path)
    cameras, (centre, _) = dict(around(splat)), bounds(splat)
    below = [float(cameras[name].campos[1] - centre[1]) for name in report["views"]]
    assert len(below) == 3
    assert 0 > below[0] > below[1] > below[2]  # y is down: from above, the lowest first
    page = (tmp_path / "report.html").read_text()
    assert "The original&#39;s own picture" in page
    assert "PSNR of the picture against the original" in page
    path.rename(tmp_path.parent / "model.ply")
    assert run_json("report", tmp_path)["views"] == []  # the original lies outside the folder


def test_as_text_the_result_comes_first(out):
    result = succeeds("report", out, "--out", out / "page.html")
    assert "x fewer fragments" in result.stdout.splitlines()[0]
    assert (out / "page.html").exists()
    assert not (out / "report.html").exists()


@pytest.mark.parametrize(
    ("name", "found", "remedy"),
    [
        ("pruned.ply", "a file", "fragprune view "),
        ("nowhere", "no such folder", "Check the name"),
        ("empty", "no file *.fragprune.json in it or below", "Run one of these first."),
    ],
)
def test_where_no_record_is_the_next_command_is_named(out, name, found, remedy):
    (out / "empty").mkdir()
    error = run_error("report", out / name, "--json")
    assert (error["where"], error["found"]) == (str(out / name), found)
    assert remedy in error["remedy"]
    assert "run or finetune" in error["expected"]
    assert (f"fragprune report {out};" in error["remedy"]) == (name == "pruned.ply")
    assert not list((out / "empty").iterdir())


def test_comparisons_come_along_with_their_pictures(out, data):
    pruned = out / "pruned.ply"
    run_json("compare", pruned, pruned, "--data", data, "--out", out / "pictures")
    run_json("profile", pruned, "--data", data, "--out", out / "more")
    report = run_json("report", out)
    assert report["command"] == "finetune"
    page = (out / "report.html").read_text()
    assert "<h2>Comparison</h2>" in page
    assert "<p>A is ../pruned.ply, B is ../pruned.ply: as many fragments" in page
    assert "<h2>Profile</h2>" in page
    assert "without cutoffs" in page
    assert "truncated" not in page
    for heading, pictures in (("Comparison", "pictures"), ("Profile", "more")):
        views = [file.stem.removesuffix("_panel") for file in (out / pictures).glob("*.png")]
        assert all(f"<h2>{heading}: {view}</h2>" in page for view in views)
    alone = run_json("report", out / "pictures")
    assert (alone["command"], alone["views"]) == ("compare", [])
    said = "../pruned.ply with cutoffs, against itself without cutoffs: "
    assert run_json("report", out / "more")["result"].startswith(said)


def test_without_the_photographs_there_are_curves_and_the_reason(out, data, record, tmp_path):
    record.data["photographs"]["folder"] = str(tmp_path / "moved")
    records.leave(out / "pruned", "finetune", record.data)
    said = succeeds("report", out).stdout
    assert "No views are shown: they need files outside of" in said
    assert run_json("report", out)["pictures"] == 1
    assert len(run_json("report", out, "--data", data)["views"]) > 0
    elsewhere = ("--data", tmp_path / "nowhere")
    assert run_error("report", out, *elsewhere, "--json")["code"] == "dataset"


@pytest.mark.parametrize(
    "edit",
    [
        Model.untruncated,
        lambda m: m.keep(m.opacity[:, 0] > 0),
        lambda m: replace(m, opacity=m.opacity - 1),  # as another training does
    ],
)
def test_a_model_that_was_edited_since_is_not_shown_with_its_old_figures(out, data, edit):
    fp.save(out / "pruned.ply", edit(load(out / "pruned.ply")))
    report = run_json("report", out, "--data", data)
    said = "pruned.ply was written again since: its figures are of the file before."
    assert report["notes"] == [said, "No views are shown: pruned.ply was changed since."]
    assert said in (out / "report.html").read_text()


def test_a_result_of_run_that_was_written_over_is_told_of_too(finetuned, tmp_path):
    model = shutil.copy(finetuned[0] / "model.ply", tmp_path / "model.ply")
    data = {**finetuned[1], "model_after": str(model)}
    records.leave(model, "run", {key: each for key, each in data.items() if key != "out"})
    assert run_json("report", tmp_path)["notes"] == []
    fp.save(model, replace(load(model), opacity=load(model).opacity - 1))
    (said,) = run_json("report", tmp_path)["notes"]
    assert "model.ply was written again since" in said


def test_what_a_fine_tuning_leaves_names_no_folder_of_the_machine(finetuned, out, data, tmp_path):
    run_json("report", out, "--data", data, "--out", out.parent / "page.html")
    run_json("compare", *[out / "pruned.ply"] * 2, "--out", out.parent / "pictures")
    for file in (each for each in out.parent.rglob("*") if each.is_file()):
        content = file.read_bytes()
        assert str(finetuned[0]).encode() not in content, file
        assert str(tmp_path).encode() not in content, file


def test_models_and_photographs_are_found_where_the_whole_tree_was_moved_to(finetuned, out, data):
    same = run_json("compare", out.parent / "model.ply", out / "pruned.ply")
    assert same["scene"]["folder"] == str(data)
    assert same["b"]["psnr"] == pytest.approx(finetuned[1]["after"]["psnr"], rel=1e-6)


@pytest.mark.parametrize(
    ("text", "written"),
    [
        ("{home}/out/a.ply", "a.ply"),
        ("{home}/scene", "../scene"),
        ("{tmp}/data/scene", "../../../data/scene"),
        ("Wrote {home}/out/a.ply.", "Wrote a.ply."),
        ("{home}/x: no such file; {home}/y", None),
        ("out/a.ply", "out/a.ply"),
    ],
)
def test_a_record_in_the_home_folder_names_no_user(tmp_path, monkeypatch, text, written):
    home = tmp_path / "home/jo"
    (home / "out").mkdir(parents=True)
    monkeypatch.setenv("HOME", str(home))
    text = text.format(home=home, tmp=tmp_path)
    data = {"model": text, "files": [text], "nothing": None, "psnr": 1.5}
    path = records.leave(home / "out/a.ply", "run", data)
    (record,) = records.find(path.parent)
    assert "jo" not in path.read_text()
    assert record.data["files"] == [record.data["model"]]
    assert (record.data["psnr"], record.data["nothing"]) == (1.5, None)
    assert written in (record.data["model"], None)
    if text.startswith("/") and " " not in text:
        assert str(records.located(record.data["model"], path.parent)) == text


def test_a_record_elsewhere_finds_the_home_folder_of_whoever_reads_it(tmp_path, monkeypatch):
    (tmp_path / "link").symlink_to(tmp_path / "home")
    monkeypatch.setenv("HOME", str(tmp_path / "link/jo"))
    for spelled in ("link/jo", "home/jo"):
        assert records.portable(str(tmp_path / spelled / "scene"), tmp_path / "out") == "~/scene"
    monkeypatch.setenv("HOME", str(tmp_path / "home/al"))
    assert records.located("~/scene", tmp_path / "out") == tmp_path / "home/al/scene"


def test_a_loss_that_is_not_known_leaves_a_gap_in_the_curves(out, record, tmp_path):
    curves = record.data["curves"]
    curves[1]["loss"] = None  # of a step that was skipped
    report_page.save_learning(tmp_path / "curves.png", curves, torch.full((60,), 0.1))
    assert (tmp_path / "curves.png").stat().st_size > 1000
    records.leave(out / "pruned.ply", "finetune", record.data)
    assert run_json("report", out)["pictures"] == 1


@pytest.mark.parametrize(("keep", "left"), [(None, ""), ("auto", ", counted from what was left")])
@pytest.mark.parametrize(
    ("goal", "said"), [("pressure", "."), ("control", ": a control, nothing is truncated.")]
)
def test_a_run_that_was_not_measured_reports_its_training_views(tmp_path, goal, said, keep, left):
    seen = {"fragments_per_pixel_before": 30.0, "fragments_per_pixel_after": 12.0}
    data = {"adapter": "my-host", "iterations": 5, "training_views": seen, "photographs": None}
    data |= {"keep": keep, "before": None, "gaussians_before": 9, "gaussians": 5 if keep else 9}
    records.leave(tmp_path / "point_cloud.ply", "run", data | {"settings": {"goal": goal}})
    report = run_json("report", tmp_path)
    assert report["result"] == (
        "my-host, 5 iterations: 2.50x fewer fragments (30.0 -> 12.0 per pixel) on training views"
        f"{left}; frame times were not measured{said}"
    )
    page = (tmp_path / "report.html").read_text()
    assert "fragments_per_pixel_" not in page
    assert re.search(r"fragments per pixel.*30\.00.*12\.00", page, re.DOTALL)


def test_a_folder_of_controls_alone_is_named_as_one(out, data, tmp_path):
    zero = tmp_path / "zero"
    words = ("--out", zero / "zero.ply", "--data", data, "--iters", 2, "--control")
    run_json("finetune", out / "pruned.ply", *words)
    text = run("report", zero).stdout
    assert ": a control, nothing is truncated." in text.splitlines()[0]
    assert "This folder holds only controls" in text
    assert "This folder holds only controls" in (zero / "report.html").read_text()
    report = run_json("report", zero)
    assert report["control"] is True
    assert report["pictures"] == 7 * len(report["views"]) + 1  # what it learned, too
    assert run_json("report", out)["control"] is False


def test_figures_that_are_not_numbers_are_null(tmp_path):
    path = records.leave(tmp_path / "a.ply", "run", {"loss": float("nan")})
    assert json.loads(path.read_text())["data"] == {"loss": None}


def test_without_being_asked_nothing_outside_of_the_folder_is_read(out, record, tmp_path):
    secret = tmp_path / "secret.png"
    tiny.save_png(secret, torch.rand(3, 8, 8))
    (out / "linked.png").symlink_to(secret)
    (out / "linked.fragprune.json").symlink_to(tmp_path / "elsewhere.fragprune.json")
    (out / "text.png").write_text("no picture, but a note")
    tiny.save_png(out / "own.png", torch.rand(3, 8, 8))
    (out / "round.png").symlink_to(out / "round.png")
    (out / "round.fragprune.json").symlink_to(out / "round.fragprune.json")
    names = ["round.png", "\0", "", "..", "linked.png", "text.png", "own.png", str(secret)]
    records.leave(out / "pruned", "finetune", record.data | {"files": names})
    opened, listening = [], True
    sys.addaudithook(lambda event, given: listening and event == "open" and opened.append(given[0]))
    report = run_json("report", out)
    listening = False  # a hook cannot be removed
    assert report["views"] == []
    assert report["pictures"] == 2  # the curves, and own.png
    touched = [str(path) for path in opened if str(path).startswith(str(tmp_path.parent))]
    assert not [path for path in touched if not path.startswith(str(out))]
    page = (out / "report.html").read_text()
    for file in (secret, out / "text.png"):
        assert base64.b64encode(file.read_bytes()).decode() not in page


@pytest.mark.parametrize(
    "content",
    [
        *("{", "[]", '{"format": "another"}'),
        *({"before": 3}, {"after": {"psnr": "high"}}, {"settings": []}, {"files": 7}),
        *({"curves": [{"step": "a"}]}, {"iterations": {}, "adapter": "x"}, {"photographs": []}),
        {"photographs": {"models": ["a"], "drawing": {}, "filtered": False}},
    ],
)
def test_a_record_that_is_none_or_of_other_types_is_refused(out, record, content):
    changed = content if isinstance(content, dict) else {}
    path = records.leave(out / "pruned", "finetune", record.data | changed)
    if not changed:
        path.write_text(content)
    result = run("report", out)
    assert result.exit_code == 1
    assert result.stderr.startswith(f"[record] {path}: ")
