"""Bent photographs are straightened: against a picture whose bend is known by formula."""

import json
import math
import sys

import numpy as np
import pytest
import torch
from PIL import Image

from fragprune_plugins.errors import DatasetError
from fragprune_plugins.workbench.scenes.dataset import load_dataset
from fragprune_plugins.workbench.scenes.posed import Lens

WIDTH, HEIGHT = 96, 64
EYE, ORIGIN = torch.eye(3, dtype=torch.float64), torch.zeros(3, dtype=torch.float64)
LENSES = {
    "radial": ((-0.12, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0), False),
    "opencv": ((-0.1, 0.02, 0.004, -0.003, 0.0, 0.0, 0.0, 0.0), False),
    "rational": ((0.1, -0.02, 0.002, 0.001, 0.01, 0.2, 0.01, 0.0), False),
    "fisheye": ((0.03, -0.01, 0.002, 0.0), True),
}


def lens(name: str, width: int = WIDTH, height: int = HEIGHT) -> Lens:
    coefficients, fisheye = LENSES[name]
    numbers = (width / WIDTH * each for each in (70, 72, 50, 31))
    return Lens(width, height, *numbers, coefficients, fisheye)


def bend(x, y, coefficients, fisheye):
    """Where a ray (x, y, 1) meets the sensor, in focal lengths (OpenCV's documentation)."""
    r2 = x * x + y * y
    if fisheye:
        r = np.sqrt(r2)
        angle = np.arctan(r)
        series = 1 + sum(k * angle**n for k, n in zip(coefficients, (2, 4, 6, 8), strict=True))
        scale = np.where(r > 1e-9, angle * series / np.maximum(r, 1e-9), 1.0)
        return x * scale, y * scale
    k1, k2, p1, p2, k3, k4, k5, k6 = coefficients
    radial = (1 + k1 * r2 + k2 * r2**2 + k3 * r2**3) / (1 + k4 * r2 + k5 * r2**2 + k6 * r2**3)
    return (
        x * radial + 2 * p1 * x * y + p2 * (r2 + 2 * x * x),
        y * radial + p1 * (r2 + 2 * y * y) + 2 * p2 * x * y,
    )


def world(x, y):
    """A smooth picture on the plane z = 1, in [0, 255]."""
    return 127.5 + 60 * np.sin(3 * x + 0.4) + 60 * np.cos(4 * y - x)


def pixels(fx, fy, cx, cy):
    v, u = np.mgrid[0:HEIGHT, 0:WIDTH] + 0.5
    return (u - cx) / fx, (v - cy) / fy


def seen(camera):
    """``world`` by a pinhole camera."""
    return world(*pixels(camera.fx, camera.fy, camera.cx, camera.cy))


def bent(of: Lens):
    """The photograph of ``world``: rays found by iteration, without OpenCV."""
    want = pixels(of.fx, of.fy, of.cx, of.cy)
    x, y = want
    for _ in range(200):
        found = bend(x, y, of.coefficients, of.fisheye)
        x, y = x + 0.7 * (want[0] - found[0]), y + 0.7 * (want[1] - found[1])
    assert max(abs(bend(x, y, of.coefficients, of.fisheye)[0] - want[0]).flat) < 1e-9
    grey = np.round(world(x, y)).astype(np.uint8)
    return np.stack([grey] * 3, axis=2)


@pytest.mark.parametrize("name", LENSES)
def test_a_straightened_photograph_is_what_its_pinhole_camera_sees(name):
    of = lens(name)
    camera = of.camera(EYE, ORIGIN)
    found = of.straighten(bent(of), camera)
    # 1.5 grey levels: two roundings, and linear interpolation of a picture that bends by at most
    # 60 (4 / 60)^2 / 8 = 0.03 between pixels. The photograph as it is differs by more.
    assert abs(found[..., 0] - seen(camera)).max() < 1.5
    assert abs(bent(of)[..., 0] - seen(camera)).max() > 5


def test_a_straight_lens_needs_no_opencv(monkeypatch):
    monkeypatch.setitem(sys.modules, "cv2", None)
    of = Lens(WIDTH, HEIGHT, 70, 72, 50, 31, (0.0,) * 8)
    camera = of.camera(EYE, ORIGIN)
    assert of.straight
    assert (camera.fx, camera.fy, camera.cx, camera.cy) == (70, 72, 50, 31)


def test_without_opencv_a_bent_lens_is_refused_with_what_to_install(monkeypatch):
    monkeypatch.setitem(sys.modules, "cv2", None)
    with pytest.raises(DatasetError, match=r"fragprune-plugins\[undistort\].*image_undistorter"):
        lens("radial").camera(EYE, ORIGIN)


def write_photographs(folder, of: Lens):
    folder.mkdir(parents=True)
    photograph = Image.fromarray(bent(of))
    for i in range(9):
        photograph.save(folder / f"view{i}.png")


def assert_straight(shot, of: Lens):
    """A photograph is what the pinhole camera of its lens sees."""
    camera = of.camera(EYE, ORIGIN)
    assert shot.view.tan_fov_x == pytest.approx(WIDTH / (2 * camera.fx))
    assert abs(255 * shot.image[0].numpy() - seen(camera)).max() < 1.5


@pytest.mark.parametrize(
    ("model", "focal", "bends"),
    [
        ("SIMPLE_RADIAL", (70,), (-0.12,)),
        ("RADIAL", (70,), (-0.12, 0.01)),
        ("OPENCV", (70, 72), (-0.1, 0.02, 0.004, -0.003)),
        ("FULL_OPENCV", (70, 72), (0.1, -0.02, 0.002, 0.001, 0.01, 0.2, 0.01, 0.0)),
        ("SIMPLE_RADIAL_FISHEYE", (70,), (0.03,)),
        ("RADIAL_FISHEYE", (70,), (0.03, -0.01)),
        ("OPENCV_FISHEYE", (70, 72), (0.03, -0.01, 0.002, 0.0)),
    ],
)
def test_colmaps_lens_models(tmp_path, model, focal, bends):
    fisheye = "FISHEYE" in model
    coefficients = (*bends, *[0.0] * 8)[: 4 if fisheye else 8]
    of = Lens(WIDTH, HEIGHT, 70, focal[-1], 50, 31, coefficients, fisheye)
    write_photographs(tmp_path / "images", of)
    sparse = tmp_path / "sparse" / "0"
    sparse.mkdir(parents=True)
    numbers = " ".join(map(str, (WIDTH, HEIGHT, *focal, 50, 31, *bends)))
    (sparse / "cameras.txt").write_text(f"1 {model} {numbers}\n")
    rows = [f"{i + 1} 1 0 0 0 {i / 10} 0 0 1 view{i}.png\n\n" for i in range(9)]
    (sparse / "images.txt").write_text("".join(rows))
    assert_straight(load_dataset(tmp_path).train[0], of)


@pytest.mark.parametrize("named", [True, False])
def test_nerfstudios_file_straightens_with_each_frames_own_lens(tmp_path, named):
    of = lens("opencv")
    write_photographs(tmp_path / "images", of)
    k1, k2, p1, p2 = of.coefficients[:4]
    bent_frame = {"distortion_params": [k1, k2, 0, 0, p1, p2]}
    if named:
        bent_frame = {"k1": k1, "k2": k2, "p1": p1, "p2": p2}
    poses = {"transform_matrix": torch.eye(4).tolist()}
    frames = [{"file_path": f"images/view{i}.png"} | poses for i in range(9)]
    frames[1] |= bent_frame
    shared = {"fl_x": 70, "fl_y": 72, "cx": 50, "cy": 31, "w": WIDTH, "h": HEIGHT}
    content = {"camera_model": "OPENCV", **shared, "frames": frames}
    (tmp_path / "transforms.json").write_text(json.dumps(content))
    first, second = load_dataset(tmp_path).train[:2]
    assert_straight(first, of)
    assert second.lens is None
    assert second.view.tan_fov_y == pytest.approx(HEIGHT / (2 * 72))


def test_smaller_images_are_straightened_by_the_same_lens():
    large, small = lens("opencv", 2 * WIDTH, 2 * HEIGHT), lens("opencv")
    camera = large.camera(EYE, ORIGIN)
    found = large.straighten(bent(small), camera)  # images_2 of the same photographs
    assert abs(found[..., 0] - seen(camera.resized(WIDTH, HEIGHT))).max() < 1.5


@pytest.mark.parametrize("wrong", [(0.1,), (math.nan,) + (0.0,) * 7, (1e9,) + (0.0,) * 7])
def test_coefficients_that_no_lens_has_are_refused(wrong):
    with pytest.raises(ValueError, match="coefficients"):
        Lens(WIDTH, HEIGHT, 70, 72, 50, 31, wrong)
