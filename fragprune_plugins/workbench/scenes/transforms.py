"""Reads transforms files: Blender's pair (NeRF synthetic), and nerfstudio's one."""

from __future__ import annotations

from pathlib import Path, PureWindowsPath
from typing import Any

import torch

from fragprune_plugins.errors import DatasetError, log, printable
from fragprune_plugins.files.reading import MEBIBYTE, UntrustedFile
from fragprune_plugins.workbench.scenes.images import find_image, image_size
from fragprune_plugins.workbench.scenes.pinhole import focal
from fragprune_plugins.workbench.scenes.posed import Lens, Posed, split

PAIR = ("transforms_train.json", "transforms_test.json")
VALIDATION = "transforms_val.json"  # stands for the second of them where that is not there
SINGLE = "transforms.json"
_PINHOLES = ("", "PINHOLE", "SIMPLE_PINHOLE")
_BENT = ("SIMPLE_RADIAL", "RADIAL", "OPENCV", "FULL_OPENCV", "PERSPECTIVE")
_FISHEYES = ("OPENCV_FISHEYE", "SIMPLE_RADIAL_FISHEYE", "RADIAL_FISHEYE")
JSON_MAX = 32 * MEBIBYTE  # ten thousand frames of nerfstudio take 11 to 13 MiB

_JSON = UntrustedFile(
    DatasetError, "not readable as JSON", "a JSON file of cameras", "Save it again.", limit=JSON_MAX
)
_TRANSFORMS = UntrustedFile(
    DatasetError,
    "not a transforms file",
    "frames with file_path and transform_matrix, and camera_angle_x or fl_x",
    "Export it again.",
)


def has_transforms(folder: Path) -> bool:
    """Whether a folder has one of the two layouts."""
    return (folder / PAIR[0]).exists() or (folder / SINGLE).exists()


def read(folder: Path, images: str = "images") -> tuple[list[Posed], list[Posed]]:
    """Read training and held-out views of Blender's pair of files, else of nerfstudio's one.

    One file may name its ``train_filenames``, and its ``test_filenames`` or ``val_filenames``.
    Otherwise every 8th of the sorted names is held out, as of COLMAP's. ``images`` names the folder
    with the images, if it is another than the file says.
    """
    if (folder / PAIR[0]).exists():
        alone = not (folder / PAIR[1]).exists() and (folder / VALIDATION).exists()
        names = (PAIR[0], VALIDATION) if alone else PAIR
        train, test = (read_transforms(folder / name, images) for name in names)
        return train, test
    path = folder / SINGLE
    rows = read_transforms(path, images)
    content = load_json(path)
    with _TRANSFORMS.stated(path):
        kept, held = (
            {_listed(each) for key in keys for each in content.get(key, ())}
            for keys in (("train_filenames",), ("test_filenames", "val_filenames"))
        )
        files = [_listed(frame["file_path"]) for frame in content["frames"]]
    if unknown := (kept | held).difference(files):
        found = f"{len(unknown)} names of its lists that no frame has: {min(unknown)}"
        remedy = "Write them as in file_path, folders and all."
        raise DatasetError(str(path), found, "the file_path of a frame for each", remedy)
    named = _there(path, list(zip(rows, files, strict=True)))
    wanted = [row for row, file in named if file not in held and (not kept or file in kept)]
    if held:
        return wanted, [row for row, file in named if file in held]
    log.warning(
        "nerfstudio itself holds out other views of a transforms.json that names none: for a model "
        "of it, train with --eval-mode interval; until then figures on held-out views include "
        "views that it was trained on"
    )
    return split(wanted)


def _there(path: Path, named: list[tuple[Posed, Path]]) -> list[tuple[Posed, Path]]:
    """The frames whose images are there, as instant-ngp has it; all if none is: another mistake."""
    there = [each for each in named if each[0].image.exists()]
    if there and (gone := [row.image for row, _ in named if not row.image.exists()]):
        said = "%s: left out %d of its %d frames, which have no image, such as %s"
        first = printable(str(gone[0]))
        log.warning(said, printable(str(path)), len(gone), len(named), first)
    return there or named


def read_transforms(path: Path, images: str = "images") -> list[Posed]:
    """Read the views of one transforms file.

    Every number may stand in a frame or in the file. Intrinsics are ``fl_x, fl_y, cx, cy`` where
    given, else ``camera_angle_x``, ``camera_angle_y`` and a centred principal point; ``w, h`` where
    given, else the size of the listed image. An ``applied_transform`` has been applied to poses.
    """
    content = load_json(path)
    with _TRANSFORMS.stated(path) as reading:
        rows = []
        for number, frame in enumerate(content["frames"]):
            reading.place = f"frames[{number}]"
            rows.append(_row(path.parent, {**content, **frame}, images))
        return rows


def load_json(path: Path) -> Any:
    """Read a JSON file."""
    with _JSON.reading(path) as reading:
        return reading.json()


def matrix(values: Any, *shapes: tuple[int, ...]) -> torch.Tensor:
    """Nested lists of numbers as float64, in one of the shapes; raises ValueError."""
    found = torch.tensor(values, dtype=torch.float64)
    if tuple(found.shape) not in shapes:
        expected = " or ".join(map(str, shapes))
        raise ValueError(f"numbers of shape {tuple(found.shape)}, not {expected}")
    return found


def opengl_pose(to_world: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
    """Rotation (3, 3) and translation (3,), world to camera, of a camera to world (3, 4).

    ``to_world`` has OpenGL's axes (y up, z back), the result COLMAP's (y down, z forward).
    """
    rotation = (to_world[:, :3] * torch.tensor([1.0, -1.0, -1.0])).T.contiguous()
    return rotation, -rotation @ to_world[:, 3]


def _listed(file: str) -> Path:
    """A path that a transforms file lists, to compare with others: its suffix may differ."""
    return _path(file).with_suffix("")


def _path(file: str) -> Path:
    """A path that a transforms file lists, which may have been written on Windows."""
    return Path(PureWindowsPath(file).as_posix())


def _row(folder: Path, frame: dict[str, Any], images: str) -> Posed:
    listed = _path(frame["file_path"])
    if PureWindowsPath(listed).anchor and not find_image(folder / listed).exists():
        # It was listed on another machine.
        listed = Path("images", listed.name)
    image = find_image(folder / (listed if images == "images" else Path(images) / listed.name))
    known = "fl_x" in frame
    # Pixels of the listed image; an angle is the same in an image of any size.
    measured = find_image(folder / listed) if known else image
    width, height = (int(frame["w"]), int(frame["h"])) if "w" in frame else image_size(measured)
    fx = float(frame["fl_x"]) if known else focal(width, float(frame["camera_angle_x"]))
    fy = focal(height, float(frame["camera_angle_y"])) if "camera_angle_y" in frame else fx
    usual = {"fl_y": fy, "cx": width / 2, "cy": height / 2}
    fy, cx, cy = (float(frame.get(name, number)) for name, number in usual.items())
    fisheye, coefficients = _distortion(frame)
    lens = Lens(width, height, fx, fy, cx, cy, coefficients, fisheye)
    pose = opengl_pose(matrix(frame["transform_matrix"], (4, 4), (3, 4))[:3])
    mask = folder / frame["mask_path"] if frame.get("mask_path") else None
    bent = None if lens.straight else lens
    return Posed(listed.stem, lens.camera(*pose), image, bent, mask)


def _distortion(frame: dict[str, Any]) -> tuple[bool, tuple[float, ...]]:
    """Whether a frame's lens is a fisheye, and its coefficients in OpenCV's order."""
    model = str(frame.get("camera_model", "")).upper()
    if model not in (*_PINHOLES, *_BENT, *_FISHEYES):
        found = f"camera_model {model[:80]!r}"
        expected = f"one of {', '.join((*_PINHOLES[1:], *_BENT, *_FISHEYES))}"
        remedy = "Undistort the images first (colmap image_undistorter)."
        raise DatasetError(str(frame["file_path"])[:200], found, expected, remedy)
    fisheye = model in _FISHEYES or bool(frame.get("is_fisheye"))
    if "distortion_params" in frame:  # nerfstudio's, which go before the names
        names, values = ("k1", "k2", "k3", "k4", "p1", "p2"), frame["distortion_params"]
        if len(values) != len(names) and not (len(values) == 4 and fisheye):
            raise ValueError(f"{len(values)} distortion_params, not {', '.join(names)}")
        frame = frame | dict(zip(names, values, strict=False))
    order = "k1 k2 k3 k4" if fisheye else "k1 k2 p1 p2 k3 k4 k5 k6"
    return fisheye, tuple(float(frame.get(name, 0)) for name in order.split())
