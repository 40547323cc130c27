"""Numbers of cameras as each layout writes them, against the definition of a pinhole."""

import json
import math
import struct

import pytest
import torch
from PIL import Image

from fragprune_plugins.errors import DatasetError
from fragprune_plugins.hosts.photographs import Resolution
from fragprune_plugins.workbench.scenes import colmap
from fragprune_plugins.workbench.scenes import transforms as layout
from fragprune_plugins.workbench.scenes.cameras import load_cameras, load_scene_cameras, sized
from reference_renderer.covariance import rotation_matrices

TURN = [[0.0, -1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 1.0]]  # camera to world, about z
PLACE = [1.0, 2.0, 3.0]


def written(path, content):
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(json.dumps(content))
    return path


def entry(**changed):
    size = {"width": 40, "height": 20, "fx": 30.0, "fy": 25.0}
    return {"img_name": "a.b.png", "position": PLACE, "rotation": TURN} | size | changed


@pytest.mark.parametrize("white", [False, True])
def test_a_cameras_file_gives_every_number(tmp_path, white):
    path = written(tmp_path / "cameras.json", [entry(), entry(img_name=7)])
    read = load_cameras(path, white_background=white)
    assert [name for name, _ in read] == ["a.b.png", "7"]
    view = read[0][1]
    assert (view.width, view.height) == (40, 20)
    assert view.tan_fov_x == pytest.approx(40 / (2 * 30))
    assert view.tan_fov_y == pytest.approx(20 / (2 * 25))
    assert view.background.tolist() == [float(white)] * 3
    torch.testing.assert_close(view.campos, torch.tensor(PLACE))
    to_camera = torch.tensor(TURN).T
    torch.testing.assert_close(view.viewmatrix[:3, :3], to_camera.T)
    torch.testing.assert_close(view.viewmatrix[3, :3], -to_camera @ torch.tensor(PLACE))
    centre = torch.tensor([0.0, 0.0, 2.0]) @ to_camera + torch.tensor(PLACE)  # of the picture
    clip = torch.cat([centre, torch.ones(1)]) @ view.projmatrix
    torch.testing.assert_close(clip[:2], torch.zeros(2), atol=1e-5, rtol=0)


def test_a_camera_that_is_broken_is_named_by_its_number(tmp_path):
    path = written(tmp_path / "cameras.json", [entry(), entry(rotation=TURN[:2])])
    with pytest.raises(DatasetError, match=r"\[1\].*shape \(2, 3\), not \(3, 3\)") as caught:
        load_cameras(path)
    assert caught.value.where == str(path)
    with pytest.raises(DatasetError, match=r"\[0\] \(no 'fy'\)"):
        load_cameras(written(path, [{k: v for k, v in entry().items() if k != "fy"}]))
    with pytest.raises(DatasetError, match=f"{path}: 0 cameras;"):
        load_cameras(written(path, []))


def test_divided_views_have_the_sizes_of_divided_photographs(tmp_path):
    path = written(tmp_path / "cameras.json", [entry(width=41, height=21)])
    ((name, view),) = sized(load_cameras(path), Resolution(4))
    assert (name, view.width, view.height) == ("a.b.png", 10, 5)
    assert view.tan_fov_x == pytest.approx(41 / (2 * 30))


def pose(place=PLACE):
    return [[*row, each] for row, each in zip(TURN, place, strict=True)] + [[0.0, 0.0, 0.0, 1.0]]


def transforms(**more):
    frame = {"file_path": "images/a.b.png", "transform_matrix": pose()}
    return {"w": 40, "h": 20, "fl_x": 30.0, "frames": [frame]} | more


def read(tmp_path, **more):
    return layout.read_transforms(written(tmp_path / "transforms.json", transforms(**more)))


def test_a_transforms_file_gives_every_number(tmp_path):
    (tmp_path / "images").mkdir()
    (tmp_path / "images/a.b.png").touch()
    ((name, camera, image, *_),) = read(tmp_path, fl_y=25.0, cx=19.0, cy=11.0)
    assert (name, image) == ("a.b", tmp_path / "images/a.b.png")
    assert (camera.width, camera.height, camera.fx, camera.fy) == (40, 20, 30.0, 25.0)
    assert (camera.cx, camera.cy) == (19.0, 11.0)
    flipped = torch.tensor(TURN, dtype=torch.float64) @ torch.diag(
        torch.tensor([1.0, -1.0, -1.0], dtype=torch.float64)
    )
    torch.testing.assert_close(camera.rotation, flipped.T)
    torch.testing.assert_close(camera.translation, -flipped.T @ torch.tensor(PLACE).double())


def test_what_a_transforms_file_leaves_out_is_square_centred_and_of_the_image(tmp_path):
    ((_, camera, *_),) = read(tmp_path)
    assert (camera.fy, camera.cx, camera.cy) == (30.0, 20.0, 10.0)
    (tmp_path / "images").mkdir()
    Image.new("RGB", (50, 30)).save(tmp_path / "images/c.png")
    frame = {"file_path": "images/c", "transform_matrix": pose()}
    content = transforms(camera_angle_x=1.0, frames=[frame])
    del content["w"], content["fl_x"]
    ((name, camera, image, *_),) = layout.read_transforms(written(tmp_path / "t.json", content))
    assert (name, image.name) == ("c", "c.png")  # named without its extension
    assert (camera.width, camera.height) == (50, 30)
    assert camera.fx == camera.fy == pytest.approx(50 / (2 * math.tan(0.5)))


def test_three_rows_of_a_pose_are_enough(tmp_path):
    short = {"file_path": "a.png", "transform_matrix": pose()[:3]}
    ((_, camera, *_),) = read(tmp_path, frames=[short])
    torch.testing.assert_close(camera.view().campos, torch.tensor(PLACE))


@pytest.mark.parametrize("place", range(8))
def test_each_number_of_a_lens_has_its_place_in_opencvs_order(tmp_path, place):
    pytest.importorskip("cv2")
    key = ("k1", "k2", "p1", "p2", "k3", "k4", "k5", "k6")[place]
    assert read(tmp_path, **{key: 0.0})[0].lens is None
    (row,) = read(tmp_path, **{key: 0.001}, camera_model="OPENCV")
    assert row.lens.coefficients == tuple(0.001 * (place == each) for each in range(8))
    assert row.lens.fisheye is False


@pytest.mark.parametrize("more", [{"camera_model": "OPENCV_FISHEYE"}, {"is_fisheye": True}])
def test_a_fisheye_has_four_numbers(tmp_path, more):
    pytest.importorskip("cv2")
    (row,) = read(tmp_path, k1=0.001, k2=0.002, k3=0.003, k4=0.004, p1=1.0, **more)
    assert row.lens.coefficients == (0.001, 0.002, 0.003, 0.004)
    assert row.lens.fisheye is True
    assert read(tmp_path, camera_model="OPENCV", is_fisheye=False)[0].lens is None


def test_a_frame_that_is_broken_is_named_by_its_number(tmp_path):
    broken = {"file_path": "b.png", "transform_matrix": [[1.0]]}
    with pytest.raises(
        DatasetError, match=r"frames\[1\].*shape \(1, 1\), not \(4, 4\) or \(3, 4\)"
    ):
        read(tmp_path, frames=[*transforms()["frames"], broken])


def test_a_blender_scene_is_its_two_files(tmp_path):
    for part in ("train", "test"):
        (tmp_path / f"{part}.png").touch()
        frame = {"file_path": f"{part}.png", "transform_matrix": pose()}
        written(tmp_path / f"transforms_{part}.json", transforms(frames=[frame]))
    train, test = layout.read(tmp_path)
    assert ([row[0] for row in train], [row[0] for row in test]) == (["train"], ["test"])
    cameras = load_scene_cameras(tmp_path, white_background=True)
    assert [[name for name, _ in part] for part in cameras] == [["train"], ["test"]]
    assert cameras[0][0][1].background.tolist() == [1.0] * 3
    assert load_scene_cameras(tmp_path)[1][0][1].background.tolist() == [0.0] * 3


HALF = math.sqrt(0.5)  # a quarter turn about z, as a quaternion w, x, y, z


@pytest.mark.parametrize("quaternion", [(0.5,) * 4, (0.1, 0.2, 0.3, 0.4), (-3.0, 1.0, 2.0, -1.0)])
def test_a_quaternion_of_any_length_turns_as_the_oracle_has_it(quaternion):
    q = torch.tensor([quaternion], dtype=torch.float64)
    expected = rotation_matrices(torch.nn.functional.normalize(q))[0]
    torch.testing.assert_close(colmap._rotation(quaternion), expected)


@pytest.mark.parametrize("quaternion", [(0.0,) * 4, (math.nan, 0, 0, 1), (math.inf, 0, 0, 0)])
def test_a_quaternion_that_is_no_rotation_is_refused(quaternion):
    with pytest.raises(ValueError, match="which is no rotation"):
        colmap._rotation(quaternion)


CODES = {7: 5, 10: 12, 11: 16, 12: 4, 13: 5}


def binary(tmp_path, cameras, images):
    model = tmp_path / "sparse/0"
    model.mkdir(parents=True, exist_ok=True)
    (model / "cameras.bin").write_bytes(struct.pack("<Q", len(cameras)) + b"".join(cameras))
    (model / "images.bin").write_bytes(struct.pack("<Q", len(images)) + b"".join(images))
    return colmap.read(tmp_path)


def camera(number=7, code=1, *values):
    values = values or (30.0, 25.0, 19.0, 11.0)
    return struct.pack(f"<iiQQ{len(values)}d", number, code, 40, 20, *values)


def image(name=b"a.png", number=7, points=2):
    numbers = struct.pack("<i7di", 5, HALF, 0, 0, HALF, *PLACE, number)
    return numbers + name + b"\0" + struct.pack("<Q", points) + b"p" * 24 * points


def text(tmp_path):
    model = tmp_path / "sparse"
    model.mkdir()
    (model / "cameras.txt").write_text(
        "# comment\n\n7 PINHOLE 40 20 30 25 19 11\n8 SIMPLE_PINHOLE 40 20 70 25 30\n"
    )
    rows = [f"1 {2 * HALF} 0 0 {2 * HALF} 1 2 3 7 sub/b c.png", "0 0 -1", "2 1 0 0 0 0 0 0 8 a.png"]
    (model / "images.txt").write_text("# comment\n" + "\n".join(rows) + "\n\n")


def both_in_binary(tmp_path):
    images = [image(b"sub/b c.png"), image(b"a.png", 8, 0)]
    binary(tmp_path, [camera(), camera(8, 0, 70.0, 25.0, 30.0)], images)


@pytest.mark.parametrize("write", [text, both_in_binary])
def test_a_colmap_model_gives_every_number(tmp_path, write):
    (tmp_path / "images").mkdir()
    write(tmp_path)
    train, test = colmap.read(tmp_path)
    ((first, plain, *_),) = test
    ((second, turned, path, *_),) = train
    assert (first, second) == ("a.png", "sub/b c.png")  # of the sorted names the first is held out
    assert path == tmp_path / "images/b c.png"
    assert (turned.width, turned.height, turned.fx, turned.fy) == (40, 20, 30.0, 25.0)
    assert (turned.cx, turned.cy) == (19.0, 11.0)
    assert (plain.fx, plain.fy, plain.cx, plain.cy) == (70.0, 70.0, 25.0, 30.0)
    torch.testing.assert_close(turned.rotation, torch.tensor(TURN, dtype=torch.float64))
    assert turned.translation.tolist() == PLACE
    (tmp_path / "images/sub").mkdir()
    (tmp_path / "images/sub/b c.png").touch()
    assert colmap.read(tmp_path)[0][0][2] == tmp_path / "images/sub/b c.png"
    assert colmap.read(tmp_path, "images_4")[0][0][2] == tmp_path / "images_4/b c.png"


@pytest.mark.parametrize("code", [*CODES, 99, -1])
def test_a_lens_that_nothing_can_straighten_is_refused_by_its_name(tmp_path, code):
    cameras = [camera(7, code, *[1.0] * CODES.get(code, 3))]
    name = colmap._MODELS[code][0] if code in CODES else f"camera model number {code}"
    with pytest.raises(DatasetError, match=name):
        binary(tmp_path, cameras, [image()])


@pytest.mark.parametrize(
    ("cameras", "images", "said"),
    [
        ([camera()], [image()[:-1]], "number 1 of 1, byte 8"),
        ([camera()], [image(points=0)[:-8] + b"\0\0\0\0\0\1\0\0"], "bytes announced"),
        ([camera()], [image(b"\xff\xfe")], "number 1 of 1, byte 8"),
        ([camera()[:-1]], [image()], "number 1 of 1, byte 8 .*32 bytes announced at byte 32"),
        ([camera()], [image(number=9)], r"image a.png of camera 9; expected .*\[7\]"),
        ([camera()], [image(b"a" * 4096)], "a name without end at byte 72"),
        ([camera()], [b"x" * 72], "1 announced, in 72 bytes"),
        ([camera()], [b"x" * 73], "number 1 of 1"),
        ([b"x" * 23], [image()], "1 announced, in 23 bytes"),
    ],
)
def test_a_binary_file_that_is_cut_off_or_lies_says_where(tmp_path, cameras, images, said):
    with pytest.raises(DatasetError, match=said):
        binary(tmp_path, cameras, images)


def test_a_model_is_found_in_either_folder_and_in_either_format(tmp_path):
    assert colmap.find_model(tmp_path) is None
    for folder, kind in (("sparse", "txt"), ("sparse/0", "bin")):
        (tmp_path / folder).mkdir()
        assert colmap.find_model(tmp_path) != tmp_path / folder
        (tmp_path / folder / f"images.{kind}").touch()
        assert colmap.find_model(tmp_path) == tmp_path / folder


def test_a_line_that_is_no_camera_is_named_by_its_number(tmp_path):
    (tmp_path / "sparse").mkdir()
    (tmp_path / "sparse/images.txt").touch()
    (tmp_path / "sparse/cameras.txt").write_text("# comment\n7 PINHOLE 40 20 30 25 19 none\n")
    with pytest.raises(DatasetError, match="at line 2"):
        colmap.read(tmp_path)


def test_binary_files_count_more_than_text(tmp_path):
    binary(tmp_path, [camera()], [image(b"binary.png")])
    (tmp_path / "sparse/0/cameras.txt").write_text("7 PINHOLE 40 20 30 25 19 11\n")
    (tmp_path / "sparse/0/images.txt").write_text("1 1 0 0 0 0 0 0 7 text.png\n\n")
    assert [row[0] for row in colmap.read(tmp_path)[1]] == ["binary.png"]


def test_a_file_of_more_cameras_than_any_scene_has_is_refused_before_it_is_read(tmp_path):
    path = tmp_path / "cameras.json"
    with path.open("wb") as file:
        file.truncate(layout.JSON_MAX + 1)
    with pytest.raises(DatasetError, match=f"at most {layout.JSON_MAX} bytes"):
        load_cameras(path)
