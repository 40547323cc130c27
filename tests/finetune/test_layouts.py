"""What people have on disk: COLMAP's, Blender's and nerfstudio's folders, suffixes, masks."""

import json
import logging
import math
import re
import shutil
from pathlib import Path

import numpy as np
import pytest
import torch
from finetune import tiny
from finetune.tiny import NAMES, stems
from PIL import Image

from fragprune_plugins import load_cameras, measure
from fragprune_plugins.errors import DatasetError
from fragprune_plugins.workbench.finetune.loop import photometric_loss
from fragprune_plugins.workbench.scenes.dataset import Pictures, PixelSlot, load_dataset
from fragprune_plugins.workbench.scenes.posed import Posed, split


def write_nerfstudio(folder: Path, images, **more: object) -> Path:
    """images/ and transforms.json, as ns-process-data leaves them, with names out of order."""
    for name, image in zip(NAMES, images, strict=True):
        tiny.save_png(folder / "images" / f"{name}.png", image)
    content = tiny.transforms([f"images/{name}.png" for name in NAMES], tiny.cameras())
    content["frames"].reverse()
    content |= {"w": tiny.SIDE, "h": tiny.SIDE, "applied_transform": torch.eye(4)[:3].tolist()}
    (folder / "transforms.json").write_text(json.dumps(content | more))
    return folder


def test_nerfstudios_folder_holds_out_every_eighth_name(tmp_path, images):
    data = load_dataset(write_nerfstudio(tmp_path, images))
    assert stems(data.test) == ["view00", "view08"]
    assert stems(data.train) == NAMES[1:8]
    torch.testing.assert_close(data.train[2].view.viewmatrix, tiny.cameras()[3].view().viewmatrix)


@pytest.mark.parametrize(
    ("held", "train", "test"),
    [
        ({"val": [6], "test": [6, 7]}, NAMES[:5], NAMES[6:8]),
        ({}, NAMES[1:5], NAMES[:1]),  # the rest is ours to hold out
    ],
)
def test_nerfstudios_file_may_say_which_views_train_and_are_held_out(
    tmp_path, images, held, train, test
):
    listed = {
        f"{part}_filenames": [f"images/{NAMES[number]}.png" for number in numbers]
        for part, numbers in ({"train": range(5)} | held).items()
    }
    data = load_dataset(write_nerfstudio(tmp_path, images, **listed))
    assert (sorted(stems(data.train)), sorted(stems(data.test))) == (train, test)


def test_nerfstudios_file_goes_before_its_colmap_model(tmp_path, images):
    write_nerfstudio(tmp_path, images)
    tiny.write_colmap(tmp_path / "colmap", images)
    assert len(load_dataset(tmp_path).train) == 7
    (tmp_path / "transforms.json").unlink()
    assert stems(load_dataset(tmp_path).train) == NAMES[1:8]  # colmap/sparse/0 with images/


@pytest.mark.parametrize("named", [True, False])
def test_nerfstudio_s_own_choice_of_held_out_views_is_warned_of(tmp_path, images, named, caplog):
    """A tenth of the frames, evenly: most of ours, every eighth, it has trained on."""
    some = {"test_filenames": ["images/view03.png"]} if named else {}
    write_nerfstudio(tmp_path, images, **some)
    load_dataset(tmp_path)
    assert ("train with --eval-mode interval" in caplog.text) is not named


def test_a_smaller_image_folder_serves_and_is_named(colmap, caplog):
    (colmap / "images").rename(colmap / "images_4")
    with caplog.at_level(logging.WARNING):
        load_dataset(colmap)
    assert "reading the photographs of images_4/" in caplog.text


@pytest.mark.parametrize("write", [tiny.write_colmap, write_nerfstudio])
def test_the_image_folder_can_be_chosen(tmp_path, images, write):
    write(tmp_path, images)
    for name in NAMES:
        half = Image.new("RGB", (tiny.SIDE // 2,) * 2, (255, 0, 0))
        (tmp_path / "images_2").mkdir(exist_ok=True)
        half.save(tmp_path / "images_2" / f"{name}.png")
    shot = load_dataset(tmp_path, images="images_2").train[0]
    assert shot.image.shape == (3, tiny.SIDE // 2, tiny.SIDE // 2)
    assert float(shot.image[0].min()) == 1.0
    assert shot.view.tan_fov_x == pytest.approx(tiny.SIDE / (2 * tiny.FOCAL))


def test_focal_lengths_without_a_size_are_those_of_the_listed_images(tmp_path, images):
    """And not of the smaller ones that are read: a lens would be twice as long there."""
    known = {"fl_x": tiny.FOCAL, "fl_y": tiny.FOCAL, "cx": tiny.SIDE / 2, "cy": tiny.SIDE / 2}
    write_nerfstudio(tmp_path, images, **known)
    path = tmp_path / "transforms.json"
    content = json.loads(path.read_text())
    path.write_text(json.dumps({key: content[key] for key in content.keys() - {"w", "h"}}))
    (tmp_path / "images_2").mkdir()
    for name in NAMES:
        Image.new("RGB", (tiny.SIDE // 2,) * 2).save(tmp_path / "images_2" / f"{name}.png")
    view = load_dataset(tmp_path, images="images_2").train[0].view
    assert view.tan_fov_x == pytest.approx(tiny.SIDE / (2 * tiny.FOCAL))
    (tmp_path / "images").rename(tmp_path / "elsewhere")
    with pytest.raises(DatasetError, match=r"images/view\d\d\.png: no such image"):
        load_dataset(tmp_path)


def test_frames_without_images_are_left_out_and_counted(tmp_path, images, caplog):
    """instant-ngp's own fox lists seventeen."""
    write_nerfstudio(tmp_path, images)
    for name in NAMES[2:4]:
        (tmp_path / "images" / f"{name}.png").unlink()
    data = load_dataset(tmp_path)
    assert len(data.train) + len(data.test) == 7
    assert "left out 2 of its 9 frames" in caplog.text
    for name in {*NAMES} - {*NAMES[2:4]}:
        (tmp_path / "images" / f"{name}.png").unlink()
    with pytest.raises(DatasetError, match="no such image"):
        load_dataset(tmp_path)


def test_a_listed_name_that_no_frame_has_is_told(tmp_path, images):
    """Fewer views would be held out than somebody believes."""
    write_nerfstudio(tmp_path, images, test_filenames=["images/view01.png", "view02.png"])
    with pytest.raises(DatasetError, match=r"1 names of its lists that no frame has: view02"):
        load_dataset(tmp_path)


def test_views_for_validation_are_held_out_where_none_are_for_a_test(tmp_path, images):
    tiny.write_blender(tmp_path, images)
    (tmp_path / "transforms_test.json").rename(tmp_path / "transforms_val.json")
    assert stems(load_dataset(tmp_path).test) == ["view00", "view08"]


def test_a_file_of_the_scene_in_place_of_its_folder_is_told(tmp_path, images):
    write_nerfstudio(tmp_path, images)
    with pytest.raises(DatasetError, match=f"a file; expected a folder .* Pass {tmp_path}"):
        load_dataset(tmp_path / "transforms.json")


def test_json_may_begin_as_windows_begins_it(tmp_path, images):
    path = write_nerfstudio(tmp_path, images) / "transforms.json"
    path.write_bytes(b"\xef\xbb\xbf" + path.read_bytes())
    assert len(load_dataset(tmp_path).train) == 7


def test_a_photograph_that_lies_on_its_side_is_told_to_be_turned(colmap):
    Image.new("RGB", (32, 48)).save(colmap / "images" / "view03.png")
    (colmap / "sparse" / "0" / "cameras.txt").write_text("7 PINHOLE 48 32 36 36 24 16\n")
    for name in {*NAMES} - {"view03"}:
        Image.new("RGB", (48, 32)).save(colmap / "images" / f"{name}.png")
    with pytest.raises(DatasetError, match=r"view03\.png: 32x48 pixels.*EXIF"):
        load_dataset(colmap)


@pytest.mark.parametrize(("turn", "warned"), [(1, False), (3, True), (6, True)])
def test_photographs_that_exif_turns_in_their_own_shape_are_warned_of(colmap, turn, warned, caplog):
    path = colmap / "images" / "view03.png"
    exif = Image.Exif()
    exif[0x0112] = turn
    Image.open(path).save(path.with_suffix(".jpg"), exif=exif)
    path.unlink()
    load_dataset(colmap)
    assert ("1 of the photographs, such as" in caplog.text) == warned


@pytest.mark.parametrize("broken", [b"II*\0\xff\xff\xff\xff", b"MM\0*\0\0\0\x08\xff\xff"])
def test_a_photograph_with_broken_exif_is_read_and_named(colmap, broken, caplog):
    path = colmap / "images" / "view03.png"
    Image.open(path).save(path.with_suffix(".jpg"), exif=b"Exif\0\0" + broken)
    path.unlink()
    assert all(shot.image.isfinite().all() for shot in load_dataset(colmap).train)
    (said,) = caplog.messages
    assert "view03.jpg, have broken EXIF" in said


def test_smaller_images_may_be_rounded_to_a_pixel(colmap):
    """An eighth of 180 rows is 22.5: 2 % of the aspect."""
    (colmap / "sparse" / "0" / "cameras.txt").write_text("7 PINHOLE 320 180 360 360 160 90\n")
    for rows in (22, 23):
        for name in NAMES:
            Image.new("RGB", (40, rows)).save(colmap / "images" / f"{name}.png")
        assert load_dataset(colmap).train[0].view.tan_fov_y == pytest.approx(90 / 360)
    Image.new("RGB", (40, 21)).save(colmap / "images" / "view03.png")
    with pytest.raises(DatasetError, match=r"view03\.png: 40x21 pixels.*320x180"):
        load_dataset(colmap)


def test_parts_of_a_scene_that_colmap_could_not_join_are_told(colmap, caplog):
    whole, sparse = colmap / "sparse" / "0", colmap / "sparse"
    shutil.copytree(whole, sparse / "1")
    load_dataset(colmap)
    assert "larger part" not in caplog.text
    lines = (whole / "images.txt").read_text().splitlines(keepends=True)
    (whole / "images.txt").write_text("".join(lines[:9]))
    load_dataset(colmap)
    assert f"{sparse / '1'} is a larger part of the scene" in caplog.text
    shutil.rmtree(whole)
    with pytest.raises(DatasetError, match=rf"Rename {sparse / '1'} to 0"):
        load_dataset(colmap)


@pytest.mark.parametrize("suffix", [".JPG", ".jpeg", ".PNG", ".webp"])
def test_images_under_another_suffix_are_found(colmap, suffix):
    for path in list((colmap / "images").iterdir()):
        path.rename(path.with_suffix(suffix))
    shot = load_dataset(colmap).train[0]
    assert shot.path.suffix == suffix
    assert shot.image.shape == (3, tiny.SIDE, tiny.SIDE)


def test_names_in_another_case_are_found_where_no_other_has_them(colmap):
    for path in list((colmap / "images").iterdir()):
        path.rename(path.with_name(path.name.upper()))
    assert stems(load_dataset(colmap).train) == NAMES[1:8]
    (colmap / "images" / "View03.png").touch()
    with pytest.raises(DatasetError, match=r"view03\.png: no such image"):
        load_dataset(colmap)


def test_colmaps_text_may_come_from_windows(colmap):
    """With its mark at the beginning, its line ends and its backslashes."""
    (colmap / "images" / "left").mkdir()
    for name in NAMES:
        path = colmap / "images" / f"{name}.png"
        path.rename(path.parent / "left" / path.name)
    for path in (colmap / "sparse" / "0").iterdir():
        text = path.read_text().replace("view", "left\\view")
        path.write_text(text, encoding="utf-8-sig", newline="\r\n")
    shot = load_dataset(colmap).train[0]
    assert shot.name == "left/view01.png"
    assert shot.path == colmap / "images" / shot.name


@pytest.mark.parametrize("folder", ["images\\", ".\\images\\", "C:\\scene\\images\\", "/home/x/"])
def test_transforms_of_another_machine_list_the_images_beside_them(tmp_path, images, folder):
    path = write_nerfstudio(tmp_path, images, test_filenames=["images/view01.png"])
    named = json.dumps(folder)[1:-1]
    path = path / "transforms.json"
    path.write_text(path.read_text().replace("images/", named))
    data = load_dataset(tmp_path)
    assert [shot.path for shot in data.test] == [tmp_path / "images" / "view01.png"]
    assert len(data.train) == 8


def test_four_parameters_of_a_fisheye_are_its_coefficients(tmp_path, images):
    more = {"camera_model": "opencv_fisheye", "fl_x": 36.0}
    write_nerfstudio(tmp_path, images, **more, distortion_params=[0.1, 0.02, 0, 0])
    assert load_dataset(tmp_path).train[0].lens.coefficients == (0.1, 0.02, 0, 0)
    write_nerfstudio(tmp_path, images, fl_x=36.0, distortion_params=[0.1, 0, 0, 0])
    with pytest.raises(DatasetError, match="4 distortion_params, not k1, k2, k3, k4, p1, p2"):
        load_dataset(tmp_path)


def test_two_images_of_one_stem_are_not_guessed_between(colmap):
    path = colmap / "images" / "view03.png"
    path.with_suffix(".jpg").write_bytes(path.read_bytes())
    path.rename(path.with_suffix(".webp"))
    with pytest.raises(DatasetError, match=r"view03\.png: no such image"):
        load_dataset(colmap)


def test_the_right_folder_is_named_where_another_was_given(tmp_path, images, monkeypatch):
    scene = tiny.write_colmap(tmp_path / "scene", images)
    monkeypatch.chdir(scene / "images")
    for wrong in (scene / "images", tmp_path, Path()):
        with pytest.raises(DatasetError, match=rf"neither layout.*Pass {scene}\.$"):
            load_dataset(wrong)


def test_photographs_without_cameras_are_told_apart(tmp_path, images):
    tiny.save_png(tmp_path / "a.png", images[0])
    with pytest.raises(DatasetError, match="run COLMAP on them first"):
        load_dataset(tmp_path)


def mask_half(path: Path) -> None:
    mask = np.zeros((tiny.SIDE, tiny.SIDE), np.uint8)
    mask[:, tiny.SIDE // 2 :] = 255
    path.parent.mkdir(exist_ok=True)
    Image.fromarray(mask).save(path)


def test_what_a_mask_hides_neither_teaches_nor_counts(tmp_path, images):
    write_nerfstudio(tmp_path, images)
    content = json.loads((tmp_path / "transforms.json").read_text())
    for frame in content["frames"]:
        frame["mask_path"] = "masks/half.png"
    (tmp_path / "transforms.json").write_text(json.dumps(content))
    mask_half(tmp_path / "masks" / "half.png")
    data = load_dataset(tmp_path)
    shot = data.train[0]
    drawn = images[1].clone().requires_grad_()
    hidden = torch.ones(3, tiny.SIDE, tiny.SIDE)
    hidden[..., tiny.SIDE // 2 :] = 0
    photometric_loss(shot.looked_at(drawn + 5 * hidden), shot.image).backward()
    assert drawn.grad is not None
    assert float((drawn.grad * hidden).abs().max()) == 0
    assert float((drawn.grad * (1 - hidden)).abs().max()) > 0
    with_mask = measure(tiny.random_model(), data, repeats=1)["psnr"]
    for path in (tmp_path / "images").iterdir():  # what the mask hides changes
        pixels = np.array(Image.open(path))
        pixels[:, : tiny.SIDE // 2] = 255
        Image.fromarray(pixels).save(path)
    again = measure(tiny.random_model(), load_dataset(tmp_path), repeats=1)
    assert again["psnr"] == with_mask


def test_the_path_that_nerfstudios_viewer_saves(tmp_path):
    want = tiny.cameras()[3]
    frame = tiny.transforms(["a"], [want])["frames"][0]
    entry = {
        "camera_to_world": [number for row in frame["transform_matrix"] for number in row],
        "fov": math.degrees(2 * math.atan(tiny.SIDE / (2 * tiny.FOCAL))),
        "aspect": 1.0,
    }
    content = {"camera_path": [entry], "render_width": tiny.SIDE, "render_height": tiny.SIDE}
    path = tmp_path / "camera_path.json"
    path.write_text(json.dumps(content))
    ((_, view),) = load_cameras(path)
    torch.testing.assert_close(view.projmatrix, want.view().projmatrix)
    path.write_text(json.dumps(content | {"camera_type": "equirectangular"}))
    with pytest.raises(DatasetError, match="a path of 'equirectangular' cameras"):
        load_cameras(path)


def test_the_angle_of_the_height_is_read(tmp_path, images):
    """As instant-ngp writes it, where pixels are not square."""
    write_nerfstudio(tmp_path, images, camera_angle_y=1.0)
    view = load_dataset(tmp_path).train[0].view
    assert view.tan_fov_y == pytest.approx(math.tan(0.5))
    assert view.tan_fov_x == pytest.approx(tiny.SIDE / (2 * tiny.FOCAL))


def test_pictures_are_kept_only_while_there_is_room():
    loads: list[int] = []

    def loader(number: int):
        def load() -> torch.Tensor:
            loads.append(number)
            return torch.full((100,), number, dtype=torch.uint8)

        return load

    kept, slots = Pictures(room=250), [PixelSlot() for _ in range(5)]
    for number in (0, 1, 0, 2, 0, 1, 2):
        assert int(kept.load(slots[number], loader(number))[0]) == number
        assert kept.size <= 250
    assert loads == [0, 1, 2, 2]


def test_a_forgotten_photograph_takes_its_pixels_along():
    kept = Pictures(room=1000)
    for _ in range(50):
        kept.load(PixelSlot(), lambda: torch.zeros(100, dtype=torch.uint8))
    assert kept.size == 0


def test_copies_of_a_photograph_share_its_pixels(tmp_path, images):
    shot = load_dataset(tiny.write_colmap(tmp_path, images)).train[0]
    assert shot.image.shape == (3, tiny.SIDE, tiny.SIDE)
    shot.path.unlink()
    assert torch.equal(shot.to("cpu").image, shot.image)


def test_images_of_one_name_in_two_folders_are_two_images(tmp_path, images):
    """Cameras of a rig number their images alike: a held-out one holds out no other."""
    names = [f"cam{number % 3}/{number // 3:03d}.png" for number in range(9)]
    for name, image in zip(names, images, strict=True):
        tiny.save_png(tmp_path / name, image)
    content = tiny.transforms(names, tiny.cameras()) | {"w": tiny.SIDE, "h": tiny.SIDE}
    content |= {"train_filenames": names[2:], "test_filenames": names[:1]}
    (tmp_path / "transforms.json").write_text(json.dumps(content))
    data = load_dataset(tmp_path)
    assert [str(shot.path.relative_to(tmp_path)) for shot in data.test] == names[:1]
    assert [str(shot.path.relative_to(tmp_path)) for shot in data.train] == names[2:]


@pytest.mark.parametrize(
    ("name", "mode"),
    [("view01.png.png", "L"), *(("view01.png", m) for m in ("1", "L", "P", "LA", "RGB", "RGBA"))],
)
def test_colmaps_masks_hide_what_is_black_or_transparent(colmap, images, name, mode):
    """An editor's cut-out is white everywhere, and only its alpha says where it is."""
    path, middle = colmap / "masks" / name, tiny.SIDE // 2
    mask_half(path)
    half = Image.open(path)
    clear = Image.merge("RGBA", (*[Image.new("L", half.size, 255)] * 3, half))
    (clear if mode.endswith("A") else half).convert(mode).save(path)
    shot, other = load_dataset(colmap).train[:2]
    assert float(shot.image[..., :middle].abs().max()) == 0
    torch.testing.assert_close(shot.image[..., middle:], images[1][..., middle:], atol=2e-3, rtol=0)
    assert other.mask is None


@pytest.mark.parametrize(
    ("grey", "height", "said"),
    [
        (0, tiny.SIDE, "black everywhere"),  # the PSNR would be infinite, and so the mean of all
        (1, tiny.SIDE, r"grey levels end at 1; expected .* from 128 on"),
        (255, 2 * tiny.SIDE, r"view01\.png: 32x64 pixels"),
    ],
)
def test_a_mask_that_is_none_is_refused(colmap, grey, height, said):
    (colmap / "masks").mkdir()
    Image.new("L", (tiny.SIDE, height), grey).save(colmap / "masks" / "view01.png")
    with pytest.raises(DatasetError, match=said):
        _ = load_dataset(colmap).train[0].image


@pytest.mark.parametrize(
    ("form", "value"),
    [("PNG", np.uint16(9000)), ("TIFF", np.int32(9000)), ("TIFF", np.float32(0.5))],
)
def test_a_photograph_that_would_be_cut_to_8_bits_is_refused(colmap, form, value):
    """Pillow makes it white: a model would learn that without a word."""
    pixels = np.full((tiny.SIDE, tiny.SIDE), value)
    Image.fromarray(pixels).save(colmap / "images" / "view03.png", format=form)
    with pytest.raises(DatasetError, match=r"view03\.png: pixels of mode .*8 bits a channel"):
        load_dataset(colmap)


@pytest.mark.parametrize(
    ("names", "warned"),
    [
        (["a.jpg", "b.jpg"], False),
        (["a.jpg", "a-1.jpg"], True),
        (["x/b.jpg", "y/a.jpg"], True),
        (["a.1.jpg", "a.2.jpg"], False),
        (["a.2.jpg", "a.1.jpg"], True),
    ],
)
def test_hosts_that_hold_out_other_views_are_warned_of(names, warned, caplog):
    """By stems a comes before a-1, and by whole names after it.

    To hosts both of a.2 and a.1 are a, and stay in the order in which COLMAP lists them.
    """
    rows = [Posed(name, tiny.cameras()[0], Path(name)) for name in names]
    _, (held,) = split(rows)
    assert held.name == min(names, key=lambda name: Path(name).stem)
    assert bool(re.search("holds? out other views", caplog.text)) == warned


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
