"""The demo: its scene, its folder, and the whole, very small, as a user starts it."""

import json
import os
import subprocess
import sys
from pathlib import Path
from unittest.mock import Mock

import numpy as np
import pytest
import torch
from cli.commands import run, run_json
from PIL import Image

from fragprune_plugins.errors import InputError
from fragprune_plugins.workbench.demo import scene, work
from fragprune_plugins.workbench.demo.work import BANNER, host_command
from fragprune_plugins.workbench.figures.wording import headlines, outcome
from fragprune_plugins.workbench.scenes.dataset import load_dataset


def seen(folder, name):
    """Mean difference of the points' colours to a photograph, 8-bit levels, where they are seen."""
    dataset = load_dataset(folder)
    (shot,) = (each for each in [*dataset.train, *dataset.test] if each.name == name)
    rows = [line.split() for line in (folder / "sparse/0/points3D.txt").read_text().splitlines()]
    table = torch.tensor([[float(each) for each in row[1:7]] for row in rows])
    local = torch.cat([table[:, :3], torch.ones(len(table), 1)], 1) @ shot.view.viewmatrix
    width, height = shot.view.width, shot.view.height
    reach = local[:, 2:3] * torch.tensor([shot.view.tan_fov_x, shot.view.tan_fov_y])
    at = (local[:, :2] / reach + 1) / 2 * torch.tensor([width, height])
    inside = ((at >= 0) & (at < torch.tensor([width, height]))).all(1) & (local[:, 2] > 0)
    column, row = at[inside].long().T
    colours = 255 * shot.image[:, row, column].T
    return float((colours - table[inside, 3:]).abs().mean(1).median())


@pytest.mark.parametrize(("views", "width", "points"), [(48, 320, 4000), (9, 80, 1000)])
def test_points_have_the_photographs_colours_where_cameras_see(tmp_path, views, width, points):
    scene.make_scene(tmp_path, views=views, width=width, points=points)
    dataset = load_dataset(tmp_path)
    assert len(dataset.train) + len(dataset.test) == views
    assert len((tmp_path / "sparse/0/points3D.txt").read_text().splitlines()) == points
    with Image.open(tmp_path / "images" / "view_003.webp") as picture:
        assert picture.size == (width, width * 3 // 4)
    for name in ("view_000.webp", "view_005.webp"):
        right = seen(tmp_path, name)
        assert right < 15
        lines = (tmp_path / "sparse/0/images.txt").read_text().splitlines()
        assert name in lines[2 * int(name[5:8])]


def test_the_package_carries_less_than_a_megabyte():
    files = [path for path in scene.ROOM.rglob("*") if path.is_file()]
    assert sum(path.stat().st_size for path in files) < 900_000
    assert len(files) == scene.VIEWS + 3


def test_held_out_views_are_spread(tmp_path):
    """Every eighth camera: both halves of the arc, high and low."""
    scene.make_scene(tmp_path, width=40, points=10)
    places = np.array([shot.view.campos.numpy() for shot in load_dataset(tmp_path).test])
    azimuth = np.degrees(np.arctan2(places[:, 1], places[:, 0]))
    assert azimuth.min() < 35
    assert azimuth.max() > 55
    assert np.ptp(places[:, 2]) > 0.8


@pytest.mark.parametrize("name", ["thesis.tex", "model/precious.txt", ".DS_Store"])
def test_a_folder_that_holds_something_is_refused_and_keeps_it(tmp_path, monkeypatch, name):
    monkeypatch.setattr(work, "make_scene", Mock(side_effect=InputError("scene", "", "", "")))
    held = tmp_path / "out" / name
    held.parent.mkdir(parents=True)
    held.write_text("mine")
    result = run("demo", "--out", tmp_path / "out")
    assert result.exit_code == 1
    hidden = name[0] == "."  # of a file manager
    assert result.stderr.startswith("[input] " if hidden else "[output] ")
    assert hidden or f"holds '{name.split('/')[0]}'" in result.stderr
    assert [each for each in (tmp_path / "out").rglob("*") if each.is_file()] == [held]


TINY = """
from functools import partial
from fragprune_plugins.workbench.commands import main
from fragprune_plugins.workbench.demo import work
work.make_scene = partial(work.make_scene, views=12, width=48, points=400)
main()
"""


@pytest.fixture(scope="module")
def demo(tmp_path_factory):
    out = tmp_path_factory.mktemp("demo") / "out"
    path = os.pathsep.join(filter(None, sys.path))
    how = {"env": os.environ | {"PYTHONPATH": path, "OMP_WAIT_POLICY": "PASSIVE"}, "timeout": 240}
    words = [sys.executable, "-c", TINY, "demo", "--out", str(out), "--iters", "100", "--json"]
    result = subprocess.run(words, capture_output=True, text=True, **how)
    assert result.returncode == 0, result.stderr
    return out, json.loads(result.stdout), result.stderr


def test_report_has_the_names_of_every_report(demo):
    _, report, stderr = demo
    assert stderr.count("Training") >= 2  # progress, throughout
    names = {"psnr", "ssim", "lpips", "fragments_per_pixel", "evaluated_per_pixel", "gaussians"}
    for side in ("before", "after", "control"):
        assert names | {"frame_ms", "frame_ms_se"} <= report[side].keys()
    assert report["after"]["fragments_per_pixel"] < report["before"]["fragments_per_pixel"]
    assert report["iterations"] == 50
    assert report["keep"] is not None
    assert report["after"]["gaussians"] < report["before"]["gaussians"]
    assert report["adapter"] == "vanilla-3dgs"
    assert report["device"] == "cpu"


def test_control_shows_what_as_many_iterations_give_without_pruning(demo):
    _, report, _ = demo
    gain = report["control"]["psnr"] - report["before"]["psnr"]
    assert gain != 0
    assert report["control"]["gaussians"] == report["before"]["gaussians"]
    assert f"{gain:+.2f} dB: pruning itself makes" in outcome("run", report, report["control"])


def test_the_control_is_the_hosts_own_training_resumed_from_the_same_checkpoint(demo):
    out, report, _ = demo
    (control,) = (out / "model" / "control").rglob("point_cloud.ply")
    measured = run_json("compare", report["model_before"], control, "--data", out / "scene")
    assert measured["b"]["psnr"] == pytest.approx(report["control"]["psnr"], abs=1e-4)


def test_pictures_and_page_are_there(demo):
    out, report, _ = demo
    for file in report["files"]:
        assert (out / file).stat().st_size > 0
    page = (out / "index.html").read_text()
    for file in report["files"]:
        assert file in page or file in ("index.html", f"pictures/{BANNER}")
    (_, (_, said), _) = headlines(report, report["control"])  # the frame times of its sentence
    assert said in page
    assert Path(report["model_after"]).exists()


def test_report_shows_the_demos_folder(demo, tmp_path):
    out, demos, _ = demo
    report = run_json("report", out, "--out", tmp_path / "page.html")
    assert (report["command"], report["adapter"]) == ("run", "vanilla-3dgs")
    assert report["after"] == demos["after"]
    assert report["result"].endswith(outcome("run", demos, demos["control"]))
    removed, moved = report["notes"]
    page = (out / "index.html").read_text()
    assert removed in page
    assert moved in page
    assert "Gaussians before learning" in removed
    assert "of the others to where some were missing" in moved
    assert len(report["views"]) > 0
    text = (tmp_path / "page.html").read_text()
    assert text.count('src="data:image/png;base64,') == report["pictures"] > 7


def test_command_is_one_a_user_could_type():
    command = host_command(Path("scene"), Path("model"), 500, 4)
    assert Path(command[0]).name == "train.py"
    for flag, value in (("iterations", "500"), ("densify_until_iter", "325"), ("seed", "4")):
        assert command[command.index(f"--{flag}") + 1] == value
    assert command[-1] == "--eval"
