"""The demo's photographs agree with their cameras, and with themselves another day."""

from dataclasses import replace

import numpy as np
import pytest
from lab.room.furniture import furnish
from lab.room.photographs import SceneSettings, make_scene, photograph, photos, surface_points
from lab.room.textures import displayed

from fragprune_plugins.workbench.scenes.dataset import load_dataset

SMALL = SceneSettings(views=9, width=80, height=60, supersample=2, points=300)


@pytest.fixture(scope="module")
def world():
    return furnish(0)


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    out = tmp_path_factory.mktemp("scene")
    make_scene(out, SMALL)
    return out


def test_same_seed_same_bytes_other_seed_other_room(folder, tmp_path):
    make_scene(tmp_path / "again", SMALL)
    make_scene(tmp_path / "other", replace(SMALL, seed=1))
    files = sorted(p.relative_to(folder) for p in folder.rglob("*") if p.is_file())
    assert len(files) == SMALL.views + 3
    for file in files:
        assert (tmp_path / "again" / file).read_bytes() == (folder / file).read_bytes()
    other = (tmp_path / "other" / "images" / "view_000.webp").read_bytes()
    assert other != (folder / "images" / "view_000.webp").read_bytes()


def test_dataset_reads_back(folder):
    dataset = load_dataset(folder)
    assert [s.name for s in dataset.test] == ["view_000.webp", "view_008.webp"]
    assert len(dataset.train) == SMALL.views - 2
    cameras = {photo.name: photo for photo in photos(SMALL)}
    for shot in [*dataset.train, *dataset.test]:
        camera = cameras[shot.name]
        assert (shot.view.width, shot.view.height) == (SMALL.width, SMALL.height)
        np.testing.assert_allclose(shot.view.campos.numpy(), camera.centre, atol=1e-5)
        np.testing.assert_allclose(
            shot.view.viewmatrix.numpy()[:3, :3], camera.rotation.T, atol=1e-6
        )
        assert shot.image.std() > 0.1


def test_a_surface_point_looks_the_same_from_two_sides(world):
    """A point the first camera sees has its colour where the second camera sees it too."""
    first, second = photos(replace(SMALL, width=160, height=120))[:2]
    points, colours = surface_points(world, [first], 2000, seed=3)
    pixels, depth = second.project(points)
    inside = ((pixels > 1) & (pixels < (159, 119))).all(axis=1) & (depth > 0)
    origin = second.centre.astype(np.float32)[:, None]
    seen, _ = world.hit(origin, second.rays(pixels[inside]))
    way = np.linalg.norm(points[inside] - second.centre, axis=1)
    visible = np.abs(seen - way) < 5e-3
    assert visible.sum() > 300
    matt = np.flatnonzero(inside)[visible]
    again = displayed(world.colour(origin, second.rays(pixels[matt]))).T * 255
    error = np.abs(again - colours[matt]).max(axis=1)
    assert np.quantile(error, 0.9) < 3  # of 255; the rest are glossy, or at a shadow's edge
    picture = photograph(world, second, 2)
    column, row = np.floor(pixels[matt]).astype(int).T
    assert np.median(np.abs(picture[row, column].astype(int) - colours[matt])) < 12


def test_projection_inverts_rays():
    photo = photos(SMALL)[4]
    pixels = np.array([[0.5, 0.5], [79.5, 59.5], [40.0, 30.0]])
    points = photo.centre + 2.5 * photo.rays(pixels).T.astype(float)
    back, depth = photo.project(points)
    np.testing.assert_allclose(back, pixels, atol=1e-4)
    assert (depth > 0).all()


def test_every_ray_ends_in_the_room(world):
    for photo in photos(replace(SMALL, views=24)):
        x, y = np.meshgrid(np.linspace(0, photo.width, 9), np.linspace(0, photo.height, 7))
        rays = photo.rays(np.stack([x, y], axis=-1).reshape(-1, 2))
        _, which = world.hit(photo.centre.astype(np.float32)[:, None], rays)
        assert (which >= 0).all(), photo.name


def test_held_out_views_are_spread():
    """Every eighth camera: both halves of the arc, high and low."""
    cameras = photos(SceneSettings())[::8]
    azimuth = [np.degrees(np.arctan2(c.centre[1], c.centre[0])) for c in cameras]
    assert min(azimuth) < 35
    assert max(azimuth) > 55
    heights = [c.centre[2] for c in cameras]
    assert max(heights) - min(heights) > 0.8


def test_textures_without_the_bundled_photographs(monkeypatch, tmp_path):
    """Where scikit-image's wheel lacks the files, noise takes their place."""
    import skimage

    monkeypatch.setattr(skimage, "__file__", str(tmp_path / "__init__.py"))
    picture = photograph(furnish(0), photos(SMALL)[0], 1)
    assert picture.std() > 20
