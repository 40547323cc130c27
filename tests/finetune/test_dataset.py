"""Readers of photographs and cameras: COLMAP text and binary, Blender, cameras.json."""

from pathlib import Path

import pytest
import torch
from finetune import tiny
from PIL import Image

from fragprune_plugins.errors import DatasetError
from fragprune_plugins.workbench.scenes.dataset import load_dataset

VIEW, TEST = Path("images/view03.png"), Path("transforms_test.json")
CAMERAS, IMAGES = Path("sparse/0/cameras.txt"), Path("sparse/0/images.txt")
COLMAP, BLENDER = tiny.write_colmap, tiny.write_blender


def test_alpha_is_composited_over_the_background(tmp_path, images):
    tiny.write_blender(tmp_path, images)
    picture = Image.new("RGBA", (tiny.SIDE, tiny.SIDE), (255, 0, 0, 51))
    picture.save(tmp_path / "train" / "view01.png")
    for white, want in ((False, (0.2, 0.0, 0.0)), (True, (1.0, 0.8, 0.8))):
        shot = load_dataset(tmp_path, white_background=white).train[0]
        torch.testing.assert_close(shot.image[:, 0, 0], torch.tensor(want))
        assert torch.equal(shot.view.background, torch.full((3,), float(white)))


def test_hosts_of_3dgs_drop_the_alpha_of_colmaps_images(colmap):
    picture = Image.new("RGBA", (tiny.SIDE, tiny.SIDE), (255, 128, 0, 51))
    picture.save(colmap / "images" / "view01.png")
    shot = load_dataset(colmap, opaque=True).train[0]
    torch.testing.assert_close(shot.image[:, 0, 0], torch.tensor((1.0, 128 / 255, 0.0)))


def test_resolution_scales_images_and_intrinsics(colmap):
    full, half = load_dataset(colmap), load_dataset(colmap, resolution=2)
    assert half.train[0].image.shape == (3, 16, 16)
    torch.testing.assert_close(half.train[0].view.projmatrix, full.train[0].view.projmatrix)


def test_hosts_of_3dgs_take_the_middle_for_the_principal_point(colmap, caplog):
    whole = load_dataset(colmap).train[0]
    (colmap / CAMERAS).write_text(f"7 PINHOLE {tiny.SIDE} {tiny.SIDE} 36 36 20 16\n")
    shot = load_dataset(colmap, centred=True).train[0]
    assert torch.equal(shot.view.projmatrix, whole.view.projmatrix)
    assert torch.equal(shot.image, whole.image)
    load_dataset(colmap, centred=False)
    assert not caplog.text
    view = load_dataset(colmap).train[0].view
    assert "principal point is up to 4.0 pixels off" in caplog.text
    point = torch.cat([view.campos + view.viewmatrix[:3, 2] * 2, torch.ones(1)])  # straight ahead
    clip = point @ view.projmatrix
    assert float(clip[0] / clip[3] + 1) * tiny.SIDE / 2 == pytest.approx(20, abs=1e-4)


def test_extent_is_the_hosts(colmap):
    dataset = load_dataset(colmap)
    centres = torch.stack([shot.view.campos for shot in dataset.train])
    farthest = max((c - centres.mean(0)).norm() for c in centres)
    assert dataset.extent == pytest.approx(1.1 * float(farthest))


def missing(path):
    path.unlink()


def holds(text):
    return lambda path: path.write_text(text)


def has(old, new):
    """A text in place of another one."""
    return lambda path: path.write_text(path.read_text().replace(old, new))


@pytest.mark.parametrize(
    ("write", "file", "spoil", "words"),
    [
        (BLENDER, TEST, missing, f"{TEST}: no such file"),
        (BLENDER, TEST, holds("{}"), "not a transforms file"),
        (BLENDER, TEST, holds("{"), "not readable as JSON"),
        (BLENDER, TEST, has('"camera_angle', '"camera_model": "A", "camera_angle'), r"model 'A'"),
        (COLMAP, VIEW, missing, "view03.png: no such image"),
        (COLMAP, VIEW, holds(""), r"view03.png: not readable \(it is empty"),
        (COLMAP, VIEW, holds("text"), r"view03.png: not readable \(no PNG"),
        (COLMAP, CAMERAS, missing, "cameras.txt: no such file"),
        (COLMAP, CAMERAS, has("PINHOLE", "FOV"), r"model FOV.*image_undistorter"),
        (COLMAP, IMAGES, holds("1 1 0 0 0 0 0 0 7 view00.png\n\n"), "no training view"),
        (COLMAP, IMAGES, has("\n\n", "\n"), "at line 3 .*10 words where an image's 2D points"),
        # the sub-folders were flattened, and one camera's photographs are there
        (COLMAP, IMAGES, has("view04", "a/view02"), "view02.png: the photograph of 2 views"),
    ],
)
def test_bad_scenes_are_refused_by_name(tmp_path, images, write, file, spoil, words):
    write(tmp_path, images)
    spoil(tmp_path / file)
    with pytest.raises(DatasetError, match=words):
        load_dataset(tmp_path)


def test_photographs_that_are_held_out_and_learned_from_are_warned_of(tmp_path, images, caplog):
    assert load_dataset(tiny.write_blender(tmp_path, images)).leaked == 0
    assert not caplog.text
    (tmp_path / TEST).write_text((tmp_path / "transforms_train.json").read_text())
    assert load_dataset(tmp_path).leaked == 7
    assert "7 of the 7 held-out views are training views too" in caplog.text


def test_what_is_no_scene_or_two_is_refused_by_name(tmp_path, images):
    with pytest.raises(DatasetError, match="no such folder"):
        load_dataset(tmp_path / "none")
    with pytest.raises(DatasetError, match="neither layout"):
        load_dataset(tmp_path)
    tiny.write_colmap(tmp_path, images)
    tiny.write_blender(tmp_path, images)
    with pytest.raises(DatasetError, match="both COLMAP's and a transforms layout"):
        load_dataset(tmp_path)
