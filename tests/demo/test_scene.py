"""The demo's photographs agree with their cameras and points, at every size."""

import numpy as np
import pytest
import torch
from PIL import Image

from fragprune_plugins.workbench.demo import scene
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
