"""A model of gsplat's trainer lies in a world of its own, and is shown its photographs there."""

import struct
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from cli.commands import run, run_json
from finetune import tiny
from scipy.spatial.transform import Rotation

from fragprune_plugins.hosts.photographs import Photographs
from fragprune_plugins.plugins.hooks import engine_for
from fragprune_plugins.workbench.figures import matching
from fragprune_plugins.workbench.models.formats.ply import write_ply
from fragprune_plugins.workbench.scenes import normalised
from fragprune_plugins.workbench.scenes.dataset import load_photographs
from fragprune_plugins.workbench.scenes.normalised import worlds
from fragprune_plugins.workbench.scenes.posed import Posed

AXES = torch.tensor([1.0, 0.6, 0.3])  # of different sizes, so that their order is known


@pytest.fixture
def model():
    made = tiny.random_model(degree=0)
    return replace(made, xyz=made.xyz * AXES)


def write_points(folder, xyz, *, binary):
    sparse = folder / "sparse" / "0"
    if binary:
        with open(sparse / "points3D.bin", "wb") as file:
            file.write(struct.pack("<Q", len(xyz)))
            for i, row in enumerate(xyz.tolist()):
                file.write(struct.pack("<Q3d3BdQ", i, *row, 1, 2, 3, 0.5, i % 3))
                file.write(struct.pack("<ii", 1, 2) * (i % 3))
        return
    rows = [f"{i} {x} {y} {z} 1 2 3 0.5 1 2" for i, (x, y, z) in enumerate(xyz.tolist())]
    (sparse / "points3D.txt").write_text("\n".join(["# points", *rows]) + "\n")


@pytest.fixture(params=[False, True], ids=["text", "binary"])
def scene(request, model, tmp_path):
    folder = tmp_path / "scene"
    tiny.write_colmap(folder, tiny.photographs(model), binary=request.param)
    write_points(folder, model.xyz.double(), binary=request.param)
    return folder


def moved(model, world):
    """The model in another world; it has no harmonics that would have to turn with it."""
    into = torch.tensor(world)
    scale = float(torch.linalg.det(into[:3, :3])) ** (1 / 3)
    turn = Rotation.from_matrix((into[:3, :3] / scale).numpy())
    own = Rotation.from_quat(model.rotation[:, [1, 2, 3, 0]].double().numpy())
    x, y, z, w = (turn * own).as_quat().T
    return replace(
        model,
        xyz=(model.xyz.double() @ into[:3, :3].double().T + into[:3, 3]).float(),
        scaling=model.scaling + np.log(scale),
        rotation=torch.from_numpy(np.stack([w, x, y, z], axis=1)).float(),
    )


def test_cameras_are_at_a_distance_of_one_and_points_along_axes(scene, model):
    """What its trainer's reader promises; the cameras are at 3 from what they look at."""
    found = [np.array(each) for each in worlds(scene)]
    assert len(found) == 4
    for world in found:
        turned = world[:3, :3] * 3
        np.testing.assert_allclose(turned @ turned.T, np.eye(3), rtol=0, atol=1e-12)
        assert np.linalg.det(turned) > 0
        points = model.xyz.double().numpy() @ world[:3, :3].T + world[:3, 3]
        spread = np.cov(points, rowvar=False)
        assert spread[0, 0] > spread[1, 1] > spread[2, 2]
        np.testing.assert_allclose(spread - np.diag(np.diag(spread)), 0, rtol=0, atol=1e-12)
    turns = [world[:3, :3] @ np.linalg.inv(found[0][:3, :3]) for world in found]
    assert sorted(round(float(np.trace(turn))) for turn in turns) == [-1, -1, -1, 3]


@pytest.mark.parametrize("number", range(4))
def test_a_model_is_shown_its_photographs_where_it_lies(number, scene, model, tmp_path):
    path = tmp_path / "moved.ply"
    write_ply(path, moved(model, worlds(scene)[number]))
    result = run("profile", path, "--data", scene)
    assert "MODEL lies where gsplat's trainer turns and scales a scene to" in result.stderr
    assert run_json("profile", path, "--data", scene)["psnr"] > 40  # eight bits, float32


def test_finetune_records_where_it_lies(scene, model, tmp_path):
    """So that its page shows it there."""
    path, out = tmp_path / "moved.ply", tmp_path / "out.ply"
    world = worlds(scene)[2]
    write_ply(path, moved(model, world))
    run("finetune", path, "--data", scene, "--out", out, "--iters", 2, "--dropout", 0)
    run("report", tmp_path)
    both = run_json("compare", path, out)
    np.testing.assert_allclose(both["scene"]["world"], world, rtol=0, atol=1e-12)
    assert both["a"]["psnr"] > 40


def test_a_model_in_the_scenes_own_world_is_looked_for_nowhere_else(scene, model, monkeypatch):
    monkeypatch.setattr(matching, "worlds", None)
    read, _ = matching.matched(model, Photographs(scene), engine_for("cpu", torch.device("cpu")))
    assert read.world is None


def test_one_that_is_nowhere_is_warned_of_as_before(scene, model, tmp_path):
    path = tmp_path / "other.ply"
    write_ply(path, replace(model, xyz=model.xyz + 100))
    assert "hardly shows these pictures" in run("profile", path, "--data", scene).stdout


def test_without_points_nobody_knows_where(scene):
    for file in scene.glob("sparse/0/points3D.*"):
        write_points(scene, torch.zeros(3, 3), binary=file.suffix == ".bin")
        assert worlds(scene) == []
        file.unlink()
    assert worlds(scene) == []
    assert worlds(Path("nowhere")) == []


@pytest.mark.parametrize("place", [float("nan"), float("inf"), 1e300, -1e20, 7.0])
def test_points_that_are_nowhere_or_in_one_place_end_nothing(place, scene):
    """The file may be anybody's. Cameras refuse a world that is none."""
    points = torch.ones(9, 3).double() * place
    write_points(scene, points, binary=(scene / "sparse/0/points3D.bin").exists())
    found = worlds(scene)
    assert len(found) == (4 if place == 7 else 0)
    for world in found:
        load_photographs(Photographs(scene, world=world))


def test_cameras_in_one_place_have_no_such_world(model, tmp_path, monkeypatch):
    """Those of a panorama: nothing is divided by zero, and nothing fails."""
    rows = [replace(each, translation=torch.zeros(3).double()) for each in tiny.cameras()]
    posed = [Posed(f"{i}", each, Path(f"{i}"), None, None) for i, each in enumerate(rows)]
    monkeypatch.setattr(normalised, "read_scene", lambda *_, **__: (posed, []))
    monkeypatch.setattr(normalised.colmap, "points", lambda _: model.xyz.double().numpy())
    assert worlds(tmp_path) == []
