"""Photographs are read at the size that the host reads them at, or refused."""

import shutil
from dataclasses import replace
from pathlib import Path

import pytest
import torch
from finetune import tiny
from hypothesis import given
from hypothesis import strategies as st
from miniatures.runs import edit
from miniatures.skeletons import skeleton

from fragprune_graphdeco.adapter import resolution
from fragprune_plugins.adapting import HostRepo, NotComparedError, Photographs, Resolution
from fragprune_plugins.errors import RecordError
from fragprune_plugins.workbench.demo import work
from fragprune_plugins.workbench.figures import records
from fragprune_plugins.workbench.figures.records import Recorded, recorded
from fragprune_plugins.workbench.scenes.dataset import load_photographs
from fragprune_vanilla_3dgs import Vanilla3DGS

HOST = HostRepo(Path(work.__file__).with_name("host"))
SIDES = st.integers(1, 6000)
WORLD = ((0.0, -2.0, 0.0, 1.0), (2.0, 0.0, 0.0, 0.0), (0.0, 0.0, 2.0, -3.0), (0.0, 0.0, 0.0, 1.0))


def command(*words, host=HOST):
    """What is known of a command's photographs; of a changed host, if its folder is given."""
    repo = host if host is HOST else HostRepo(host)
    return Vanilla3DGS().photographs(repo, ["-s", "scene", "--eval", *words])


@pytest.fixture
def own(tmp_path):
    """A copy of the host, to be changed."""
    return shutil.copytree(HOST.root, tmp_path, dirs_exist_ok=True)


@pytest.mark.parametrize(
    ("words", "size"),
    [
        ((), (1600, 1066)),  # 3,000 x 2,000 is wider than hosts read unasked
        (("-r", "-1"), (1600, 1066)),
        (("-r", "1"), (3000, 2000)),
        (("--resolution=4",), (750, 500)),
        (("-r8",), (375, 250)),
        (("-r", "800"), (800, 533)),
        (("-r", "3"), (3, 2)),  # no divisor of this host: a width
    ],
)
def test_the_size_follows_the_command_as_the_host_does(words, size):
    assert command(*words).resolution.of(3000, 2000) == size


def test_small_photographs_are_not_enlarged_unasked():
    assert command().resolution.of(800, 600) == (800, 600)
    assert command("-r", "1600").resolution.of(800, 600) == (1600, 1200)


@given(SIDES, SIDES)
def test_unasked_no_side_grows_and_the_aspect_stays(width, height):
    wide, high = command().resolution.of(width, height)
    assert wide <= min(width, 1600)
    assert high <= height
    assert abs(high - height * min(1, 1600 / width)) <= 1


@pytest.mark.parametrize("value", [0, -2])
def test_a_size_that_makes_no_sense_is_refused(value):
    with pytest.raises(NotComparedError, match=f"-r {value}"):
        command("-r", str(value))


@pytest.mark.parametrize(
    ("source", "size"),
    [
        ("def loadCam(args):\n    if args.resolution in [1, 2]: 1600\n", Resolution(divide=2)),
        ("def loadCam(args):\n    if args.resolution in [1, 16]: 1600\n", Resolution(width=2)),
        ("def loadCam(args):\n    if args.resolution in [1, 2]: 1200\n", None),
        *(("", None), (None, None)),
    ],
)
def test_which_numbers_are_divisors_is_read_from_the_source(tmp_path, source, size):
    (tmp_path / "utils").mkdir()
    if source is not None:
        (tmp_path / "utils/camera_utils.py").write_text(source)
    if size:
        assert resolution(HostRepo(tmp_path), 2) == size
        return
    with pytest.raises(NotComparedError, match=r"utils/camera_utils\.py|do not know"):
        resolution(HostRepo(tmp_path), 2)


def test_folder_background_and_images_are_the_commands():
    read = command("-w", "--images", "images_4")
    how = {"centred": True, "opaque": True}
    assert read == Photographs(Path("scene"), read.resolution, True, "images_4", **how)
    assert not command().white_background


def test_what_a_command_leaves_out_is_the_hosts_own(own):
    for name, usual, other in (
        ("_images", '"images"', '"images_8"'),
        ("_white_background", "False", "True"),
        ("eval", "False", "True"),
    ):
        edit(own / "arguments/__init__.py", f"self.{name} = {usual}", f"self.{name} = {other}")
    read = Vanilla3DGS().photographs(HostRepo(own), ["-s", "scene"])
    assert (read.images, read.white_background, read.held_out) == ("images_8", True, True)
    assert command("-i", "images", host=own).images == "images"


def test_the_middle_is_the_principal_point_of_a_host_that_reads_no_other(own):
    assert command().centred
    usual = "projection = getProjectionMatrix(znear, zfar, fovX, fovY"
    for more in ("", ", cx=cx"):
        (own / "scene/cameras.py").write_text(f"{usual}{more}).transpose(0, 1).cuda()\n")
        assert bool(command(host=own).centred) == (not more)


@pytest.mark.parametrize(
    ("load", "colmap", "blender"),
    [
        ("if resized_image_rgb.shape[1] == 4: loaded_mask = resized_image_rgb[3:4]", True, False),
        ("image = Image.open(cam_info.image_path)", True, True),
        ("if resized_image_rgb.shape[0] == 4: loaded_mask = resized_image_rgb[3:4]", False, False),
    ],
)
def test_alpha_is_dropped_where_the_host_drops_it(own, load, colmap, blender):
    with (own / "utils/camera_utils.py").open("a") as source:
        source.write(f"\n\ndef own(cam_info, resized_image_rgb):\n    {load}\n")
    assert command("-s", str(own), host=own).opaque == colmap
    (own / "transforms_train.json").touch()
    assert command("-s", str(own), host=own).opaque == blender


def test_a_command_that_holds_nothing_out_learns_from_all(tmp_path):
    assert command().held_out
    read = Vanilla3DGS().photographs(HOST, ["-s", str(tiny.scene(tmp_path)[0])])
    assert not read.held_out
    held, whole = load_photographs(replace(read, held_out=True)), load_photographs(read)
    names = [[shot.name for shot in part] for part in (held.train, held.test, whole.train)]
    assert sorted(names[0] + names[1]) == sorted(names[2])
    assert whole.test == []


@pytest.mark.parametrize(
    "size",
    [Resolution(), Resolution(4), Resolution(width=7), Resolution(width=9, shrink_only=True)],
)
@pytest.mark.parametrize("world", [None, WORLD])
def test_photographs_survive_a_record(size, world, tmp_path):
    read = Photographs(tmp_path, size, True, "images_2", True, world=world)
    said = Recorded(read, (tmp_path / "a.ply",))
    path = records.leave(tmp_path / "a.ply", "run", {"photographs": said.as_dict()})
    (record,) = records.find(path.parent)
    assert recorded(record) == said


@pytest.mark.parametrize("rows", [3, [], WORLD[:3], ["word"] * 4, [[0] * 4] * 4, [[1] * 3] * 4])
def test_a_record_of_a_world_that_is_no_similarity_is_refused(rows, tmp_path):
    said = Recorded(Photographs(tmp_path), (tmp_path / "a.ply",)).as_dict()
    path = records.leave(tmp_path / "a.ply", "run", {"photographs": said | {"world": rows}})
    (record,) = records.find(path.parent)
    with pytest.raises(RecordError, match="photographs"):
        recorded(record)


def test_cameras_follow_the_world_into_that_of_the_models(tmp_path):
    """A point that moves with the world is seen at the same pixel, at a scaled depth."""
    folder, scale = tiny.scene(tmp_path)[0], 2.0
    into = torch.tensor(WORLD, dtype=torch.float64)
    point = torch.tensor([0.2, -0.1, 0.3, 1.0], dtype=torch.float64)
    read = Photographs(folder)
    pairs = zip(
        load_photographs(read).train,
        load_photographs(replace(read, world=WORLD)).train,
        strict=True,
    )
    for before, after in pairs:
        there = point @ before.view.projmatrix.double()
        then = into @ point @ after.view.projmatrix.double()
        torch.testing.assert_close(then[:2] / then[3], there[:2] / there[3], rtol=1e-5, atol=1e-5)
        torch.testing.assert_close(then[3], scale * there[3], rtol=1e-5, atol=0)  # float32
        moved = into[:3, :3] @ before.view.campos.double() + into[:3, 3]
        torch.testing.assert_close(after.view.campos.double(), moved, rtol=0, atol=1e-5)
        assert torch.equal(before.image, after.image)


@pytest.mark.parametrize(
    ("passed", "default", "words", "compensated"),
    [
        ("pipe.antialiasing", False, [], False),
        ("pipe.antialiasing", False, ["--antialiasing"], True),
        ("pipe.antialiasing", True, [], True),
        ("pipe.smooth", False, ["--smooth"], True),
        ("pipe.smooth", False, ["--antialiasing"], False),
        ("True", False, [], True),
        ("False", False, ["--antialiasing"], False),
    ],
)
def test_models_are_drawn_with_antialiasing_where_their_host_does(
    tmp_path, passed, default, words, compensated
):
    repo = skeleton(tmp_path, "October 2024")
    for file, old, new in (
        ("gaussian_renderer", "antialiasing=0", f"antialiasing={passed}"),
        ("arguments", "self.iterations", f"self.antialiasing = {default}; self.iterations"),
    ):
        edit(tmp_path / file / "__init__.py", old, new)
    expected = {"compensation": "antialiasing"} if compensated else {}
    assert Vanilla3DGS().drawing(repo, ["--eval", *words]) == expected
