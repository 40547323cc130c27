"""What commands make of words that are misspelt, missing or without effect."""

import pytest
from cli.commands import fails, run, run_json
from finetune import tiny
from PIL import Image

from fragprune_plugins.workbench.commands import cli


@pytest.mark.parametrize(
    "name",
    [
        name
        for name in cli.list_commands(None)
        if any(p.name in ("model", "a") for p in cli.get_command(None, name).params)
    ],
)
def test_a_model_that_is_not_there_is_what_is_wrong(name, tmp_path):
    out = tmp_path / "out"
    words = [] if name in ("bench", "compare", "profile", "view") else ["--out", out / "x.ply"]
    asked = (name, tmp_path / "no.ply", *([tmp_path / "b.ply"] * (name == "compare")), *words)
    fails(*asked, says=("[model-file]", "no.ply: no such file"), code=1)
    assert not out.exists()


@pytest.fixture
def given(tmp_path):
    """A model, and its cameras in a file."""
    _, path, _ = tiny.scene(tmp_path)
    return path, tiny.write_path(tmp_path / "path.json", ["a", "b"])


def test_cameras_of_a_file_are_divided(given, tmp_path):
    model, cameras = given
    out = tmp_path / "pictures"
    run_json("render", model, "--cameras", cameras, "--out", out, "--resolution", 2)
    with Image.open(out / "a.png") as picture:
        assert picture.size == (10, 6)


@pytest.mark.parametrize("words", [("--views", "train"), ("--images", "images_2")])
def test_options_of_photographs_are_refused_beside_cameras(given, tmp_path, words):
    model, cameras = given
    out = tmp_path / "pictures"
    fails("render", model, "--cameras", cameras, "--out", out, *words, says=f"{words[0]}")
    assert not out.exists()


@pytest.mark.parametrize("name", ["o.gif", "film.mp4"])
def test_a_film_that_cannot_be_written_is_refused_before_it_is_drawn(
    given, tmp_path, name, monkeypatch
):
    monkeypatch.setitem(__import__("sys").modules, "imageio_ffmpeg", None)
    monkeypatch.setattr("fragprune_plugins.workbench.render.work.load", None)
    result = run("render", given[0], "--orbit", "--out", tmp_path / name)
    assert result.exit_code == 2
    assert not (tmp_path / name).exists()


def test_the_list_of_commands_cuts_no_sentence():
    assert "..." not in run("--help").stdout.split("Commands:")[1]
