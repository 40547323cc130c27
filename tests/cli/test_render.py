"""fragprune render."""

import json

import pytest
import torch
from cli.commands import run, run_json
from finetune import tiny
from finetune.several import command
from PIL import Image

from fragprune_plugins import RasterInputs, load_dataset, rasterize
from fragprune_plugins.hosts.photographs import Photographs
from fragprune_plugins.workbench.figures import records
from fragprune_plugins.workbench.figures.pictures import picture as picture_of
from fragprune_plugins.workbench.figures.records import Recorded


def size_of(file):
    with Image.open(file) as picture:
        return picture.size


@pytest.fixture
def drawn(cut, tmp_path):
    """Draws the model; what the command says, and the sizes of the pictures by name."""

    def rendered(*words):
        report = run_json("render", cut, "--out", tmp_path / "pictures", *words)
        files = sorted((tmp_path / "pictures").iterdir())
        assert sorted(report["files"]) == [str(file) for file in files]
        return report, {file.name: size_of(file) for file in files}

    return rendered


def test_held_out_views(data, drawn):
    report, sizes = drawn("--data", data)
    assert sizes == dict.fromkeys(["view00.png", "view08.png"], (tiny.SIDE, tiny.SIDE))
    plain, _ = drawn("--data", data, "--no-truncation")
    assert (plain["truncated"], report["truncated"]) == (False, True)
    assert plain["fragments_per_pixel"] > report["fragments_per_pixel"]
    assert len(drawn("--data", data, "--views", "all")[1]) == 9


def test_a_model_is_drawn_as_the_run_did_that_trained_it(data, cut, model, tmp_path, caplog):
    """Commands that cannot, say so."""
    rules = {"compensation": "antialiasing"}
    told = Recorded(Photographs(data, centred=True), (cut, cut), filtered=True, drawing=rules)
    records.leave(cut, "run", {"photographs": told.as_dict()})
    run_json("render", cut, "--data", data, "--out", tmp_path)
    shot = load_dataset(data).test[0]
    inputs = RasterInputs(shot.view, model.splats(), **rules)
    with torch.no_grad():
        expected = rasterize(inputs, torch.full((len(model),), 0.3)).image
    with Image.open(tmp_path / "view00.png") as picture:
        assert picture.tobytes() == picture_of(expected).tobytes()
    compared, profiled = run_json("compare", cut, cut), run_json("profile", cut, "--data", data)
    assert profiled["psnr"] == compared["a"]["psnr"]
    for words in (
        ("view", cut, "--out", tmp_path / "page.html"),
        ("audit", cut, "--data", data, "--views", 1),
        ("finetune", cut, "--data", data, "--iters", 1, "--out", tmp_path / "out.ply"),
    ):
        caplog.clear()
        run(*words)
        assert "was trained with antialiasing" in caplog.text, words


@pytest.mark.parametrize("size", [2, 3])
def test_gaussians_divided_among_processes_give_the_same_pictures(data, cut, tmp_path, size):
    words = ("render", cut, "--data", data, "--out")
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


def test_a_film_is_not_drawn_by_several_processes(data, cut, tmp_path):
    film = tmp_path / "film.mp4"
    ended = command(2, "render", cut, "--data", data, "--out", film, "--shard-gaussians")
    assert [each.left[0] for each in ended] == [2, 2]


@pytest.mark.parametrize("divide", [1, 2])
def test_cameras_of_a_file_two_of_which_have_one_name(drawn, tmp_path, divide):
    cameras = tiny.write_path(tmp_path / "path.json", ["train/r_0", "test/r_0"])
    report, sizes = drawn("--cameras", cameras, "--resolution", divide)
    assert sizes == dict.fromkeys(["r_0-2.png", "r_0.png"], (20 // divide, 12 // divide))
    assert report["warnings"] == []


def test_a_view_that_shows_nothing_is_warned_of(cut, tmp_path):
    path = tiny.write_path(tmp_path / "path.json", ["a", "b"])
    content = json.loads(path.read_text())
    content["frames"][1]["transform_matrix"][2][3] = 1e5
    path.write_text(json.dumps(content))
    words = ("render", cut, "--cameras", path, "--out", tmp_path / "pictures")
    said = run(*words).stdout
    assert "Wrote 2 pictures" in said
    assert "Warning: 1 of 2 show no Gaussian" in said
    assert len(run_json(*words)["warnings"]) == 1
