"""Films: where the camera is in each frame, and what the file holds."""

import re
import resource
import subprocess
import sys

import imageio_ffmpeg
import numpy as np
import pytest
import torch
from cli.commands import fails, run_json
from finetune import tiny

from fragprune_plugins.errors import OutputError
from fragprune_plugins.workbench.models.formats.ply import write_ply
from fragprune_plugins.workbench.render import work
from fragprune_plugins.workbench.render.filming import along, orbit, write_mp4
from fragprune_plugins.workbench.scenes.generated import bounds


def frames_of(path):
    """Size, frames a second, and the pictures of a film."""
    program = imageio_ffmpeg.get_ffmpeg_exe()
    said = subprocess.run([program, "-i", str(path)], capture_output=True, text=True).stderr
    width, height = map(int, re.search(r" (\d+)x(\d+)[ ,]", said).groups())
    fps = float(re.search(r"([\d.]+) fps", said)[1])
    raw = ["-f", "rawvideo", "-pix_fmt", "rgb24", "-"]
    done = subprocess.run([program, "-i", str(path), *raw], capture_output=True, check=True)
    pictures = np.frombuffer(done.stdout, np.uint8).reshape(-1, height, width, 3)
    return (width, height), fps, pictures


@pytest.mark.parametrize("up", [(0.0, -1.0, 0.0), (0.0, 0.0, 1.0), (1.0, 2.0, -0.5)])
def test_an_orbit_goes_once_around_at_one_height_and_distance(up):
    splat = tiny.random_model()
    centre, _ = bounds(splat)
    axis = torch.nn.functional.normalize(torch.tensor(up), dim=0)
    away = torch.stack([view.campos - centre for _, view in orbit(splat, 12, up)])
    heights = away @ axis
    assert float(heights.std()) < 1e-4 * float(heights.abs().mean())
    assert float(heights.mean()) > 0
    distances = away.norm(dim=1)
    assert float(distances.std()) < 1e-4 * float(distances.mean())
    flat = torch.nn.functional.normalize(away - heights[:, None] * axis, dim=1)
    turns = (flat * flat.roll(1, 0)).sum(dim=1)
    torch.testing.assert_close(turns, torch.full((12,), 3**0.5 / 2), atol=1e-4, rtol=0)


def test_a_path_begins_and_ends_at_its_cameras_and_passes_the_others():
    cameras = [(str(i), camera.view()) for i, camera in enumerate(tiny.cameras()[:3])]
    found = along(cameras, 9)
    for at, (_, camera) in zip((0, 4, 8), cameras, strict=True):
        torch.testing.assert_close(found[at][1].viewmatrix, camera.viewmatrix, atol=1e-5, rtol=0)
        torch.testing.assert_close(found[at][1].projmatrix, camera.projmatrix, atol=1e-4, rtol=0)
    halfway = (cameras[0][1].campos + cameras[1][1].campos) / 2
    torch.testing.assert_close(found[2][1].campos, halfway, atol=1e-5, rtol=0)


@pytest.mark.parametrize("count", [1, 2, 5])
def test_a_path_of_one_camera_stands_still(count):
    cameras = [("a", tiny.cameras()[0].view())]
    for _, view in along(cameras, count):
        torch.testing.assert_close(view.viewmatrix, cameras[0][1].viewmatrix)


def test_a_film_holds_the_pictures_in_their_order(tmp_path):
    greys = [0.1, 0.5, 0.9]
    pictures = [torch.full((3, 49, 65), grey) for grey in greys]
    write_mp4(tmp_path / "a.mp4", pictures, 10)
    size, fps, found = frames_of(tmp_path / "a.mp4")
    assert size == (64, 48)
    assert fps == 10
    assert len(found) == 3
    for picture, grey in zip(found, greys, strict=True):
        assert abs(float(picture.mean()) - 255 * grey) < 4  # H.264 loses a little


def test_a_film_has_the_colours_of_its_pictures_and_says_which_they_are(tmp_path):
    """Players guess by its size else."""
    path, green = tmp_path / "a.mp4", torch.tensor([0.1, 0.8, 0.2])
    write_mp4(path, [green[:, None, None].expand(3, 48, 64)], 10)
    words = [imageio_ffmpeg.get_ffmpeg_exe(), "-i", str(path)]
    said = subprocess.run(words, capture_output=True, text=True).stderr
    assert "yuv420p(tv, bt709/bt709/iec61966-2-1" in said
    assert np.abs(frames_of(path)[2][0] - 255 * green.numpy()).max() < 4


def test_a_film_that_fails_or_that_a_full_disk_cuts_off_leaves_the_earlier_one(tmp_path):
    path = tmp_path / "a.mp4"
    path.write_bytes(b"earlier")

    def frames():
        yield torch.zeros(3, 32, 32)
        raise RuntimeError("no more")

    with pytest.raises(RuntimeError, match="no more"):
        write_mp4(path, frames(), 10)
    soft, hard = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (1000, hard))
    try:
        with pytest.raises(OutputError, match="not written to its end"):
            write_mp4(path, [torch.rand(3, 64, 64)] * 3, 10)
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, (soft, hard))
    assert path.read_bytes() == b"earlier"
    assert list(tmp_path.iterdir()) == [path]


def test_render_films_an_orbit_and_a_path(tmp_path, monkeypatch):
    monkeypatch.setattr(work, "FRAMES", 4)
    data, model, splat = tiny.scene(tmp_path)
    film = tmp_path / "a.mp4"
    report = run_json("render", model, "--orbit", "--resolution", 16, "--out", film)
    assert report["files"] == [str(film)]
    size, fps, pictures = frames_of(film)
    assert (size, fps, len(pictures)) == ((80, 44), 30, 4)
    run_json("render", model, "--data", data, "--views", "train", "--out", film)
    size, _, pictures = frames_of(film)
    assert (size, len(pictures)) == ((tiny.SIDE, tiny.SIDE), 7)  # a frame for each camera
    assert max(float(picture.std()) for picture in pictures) > 5
    words = ("--orbit", "--resolution", 16, "--out", tmp_path / "pictures")
    assert len(run_json("render", model, *words)["files"]) == 4  # or pictures
    write_ply(model, tiny.cut(splat, 0.5))  # thresholds apply to films, too
    assert run_json("render", model, "--orbit", "--out", film)["truncated"]


def test_without_the_library_the_message_says_what_to_install(tmp_path, monkeypatch):
    _, model, _ = tiny.scene(tmp_path)
    monkeypatch.setitem(sys.modules, "imageio_ffmpeg", None)
    monkeypatch.setattr(work, "load", None)  # refused before it is drawn
    fails("render", model, "--orbit", "--out", tmp_path / "a.mp4", says="fragprune-plugins[video]")
    assert not (tmp_path / "a.mp4").exists()
