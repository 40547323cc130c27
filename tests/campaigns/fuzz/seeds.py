"""Small good files of every kind, made from numbers, and the inputs that once broke a reader."""

import gzip
import io
import json
import struct
import tempfile
import zipfile
from functools import cache
from itertools import chain
from pathlib import Path

import numpy as np
import torch
from finetune import tiny
from miniatures.vanilla_3dgs import HOST
from PIL import Image
from plyfile import PlyData

from fragprune_plugins.files import sidecar
from fragprune_plugins.learning.thresholds import ThresholdStore
from fragprune_plugins.workbench.figures import records
from fragprune_plugins.workbench.finetune.resuming import Checkpoints
from fragprune_plugins.workbench.models import formats
from fragprune_plugins.workbench.models.formats.ply import write_ply
from fragprune_plugins.workbench.models.formats.spz import zstd

CORPUS = Path(__file__).parent / "corpus"
"""Of what was found, in a folder for each reader."""

_LENSES = b"""7 OPENCV 32 32 36 36 16 16 -0.1 0.02 0.001 0.002
8 SIMPLE_RADIAL_FISHEYE 32 32 36 16 16 0.03
"""

_ARGUMENTS = (
    b"Namespace(sh_degree=3, source_path='scene', model_path='out', images='images', "
    b"resolution=-1, white_background=False, data_device='cuda', eval=True)"
)

_SETTINGS = b"""iters = 300
train = "opacity"
log = ["csv:a.csv"]
no-truncation = true
pressure = 1e-3
images = "images_2"
"""

GAUSSIANS = 3
VIEWS = 3

FIGURES = {
    "target": "photographs",
    "psnr": 30.0,
    "ssim": 0.9,
    "lpips": None,
    "fragments_per_pixel": 20.0,
    "evaluated_per_pixel": 40.0,
    "area_per_pixel": 60.0,
    "gaussians": 3,
    "frame_ms": 1.5,
    "frame_ms_se": 0.1,
    "engine": "cpu",
    "device": "cpu",
    "views": 2,
}


def model(degree: int = 0, count: int = GAUSSIANS) -> bytes:
    """A splat of a few Gaussians as a binary PLY."""
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "m.ply"
        write_ply(path, tiny.cut(tiny.random_model(count, degree), 0.2))
        return path.read_bytes()


def _formats(folder: Path) -> dict[str, dict[str, bytes]]:
    """Small models in each other format, with and without SH and thresholds."""
    made: dict[str, dict[str, bytes]] = {}
    for form in map(formats.of_suffix, formats.SUFFIXES):
        if form is formats.PLY:
            continue
        files = made.setdefault(form.suffix[1:], {})
        for degree in (0, 1):
            path = folder / f"degree{degree}{form.suffix}"
            splat = tiny.random_model(GAUSSIANS, degree)
            formats.write(form, path, tiny.cut(splat, 0.2) if form.thresholds else splat)
            files[path.name] = path.read_bytes()
    header, parts = spz_parts(made["spz"]["degree1.spz"])
    made["spz"]["version3.spz"] = gzip.compress(
        header[:4] + b"\3" + header[5:14] + b"\0\0" + b"".join(parts), mtime=0
    )
    with zipfile.ZipFile(io.BytesIO(made["sog"]["degree1.sog"])) as archive:
        made["sog.json"] = {"a.json": archive.read("meta.json")}
    return made


def spz_parts(content: bytes) -> tuple[bytes, list[bytes]]:
    """The header of an SPZ of version 4, and its decompressed streams."""
    number, (start,) = content[15], struct.unpack_from("<I", content, 16)
    at, parts = start + 16 * number, []
    for index in range(number):
        (size,) = struct.unpack_from("<Q", content, start + 16 * index)
        parts.append(zstd.decompress(content[at : at + size]))
        at += size
    return content[:16], parts


def _as(content: bytes, **how: object) -> bytes:
    """A PLY written in another way."""
    vertex = PlyData.read(io.BytesIO(content))["vertex"]
    out = io.BytesIO()
    PlyData([vertex], **how).write(out)
    return out.getvalue()


def _sidecar(folder: Path) -> bytes:
    path = folder / "m.ply"
    path.write_bytes(model())
    store = ThresholdStore(GAUSSIANS)
    store.open(torch.full((GAUSSIANS,), 0.5))
    store.logits.grad = torch.ones(GAUSSIANS)
    store.step(0.1)
    return sidecar.save(path, store, settings={"iterations": 3}).read_bytes()


def _scene(folder: Path, *, binary: bool) -> dict[str, bytes]:
    """The files of a COLMAP model with few views, by name."""
    images = [torch.rand(3, tiny.SIDE, tiny.SIDE) for _ in range(9)]
    sparse = tiny.write_colmap(folder / str(binary), images, binary=binary) / "sparse" / "0"
    return {path.name: path.read_bytes() for path in sparse.iterdir()}


def _record(folder: Path) -> bytes:
    curve = {"loss": 0.1, "fragments_per_pixel": 20.0, "threshold_median": 0.1}
    after = FIGURES | {"fragments_per_pixel": 10.0}
    data = {
        "adapter": "a-host",
        "iterations": 2,
        "before": FIGURES,
        "after": after,
        "settings": {"goal": "pressure", "train": "all", "opacity_lr": 0.02},
        "curves": [{"step": step, **curve} for step in range(3)],
        "photographs": {
            "folder": "scene",
            "resolution": {"divide": 1, "width": None, "shrink_only": False},
            "white_background": False,
            "images": "images",
            "models": ["a.ply", "b.ply"],
            "filtered": False,
            "drawing": {"dilation": 0.1},
        },
        "files": ["a.png"],
    }
    return records.leave(folder / "a.ply", "finetune", data).read_bytes()


def _image(kind: str, mode: str = "RGB") -> bytes:
    picture = np.arange(8 * 8 * len(mode), dtype=np.uint8).reshape(8, 8, len(mode))
    out = io.BytesIO()
    Image.fromarray(picture, mode=None).save(out, format=kind)
    return out.getvalue()


def _checkpoint(folder: Path) -> bytes:
    path = folder / "chkpnt7.pth"
    capture = (1, torch.rand(3, 3), {"state": {}, "param_groups": [{"lr": 0.1, "name": "xyz"}]})
    torch.save((capture, 7), path)
    return path.read_bytes()


def _progress(folder: Path) -> bytes:
    path = folder / "progress.safetensors"
    tensors = {"logits": torch.zeros(3), "exp_avg_sq.logits": torch.ones(3)}
    Checkpoints(path).save(tensors, {"configuration": {"iterations": 3}, "step": 2})
    return path.read_bytes()


def _cameras() -> bytes:
    return json.dumps(tiny.host_cameras(tiny.cameras(VIEWS))).encode()


def _transforms() -> bytes:
    names = [f"./train/r_{i}" for i in range(VIEWS)]
    content = tiny.transforms(names, tiny.cameras(VIEWS))
    return json.dumps(content | {"w": 32, "h": 32, "cx": 16.0, "cy": 16.0}).encode()


def _nerfstudio() -> bytes:
    """Intrinsics and a lens of the file, others of a frame."""
    content = tiny.transforms([f"images/{i}.png" for i in range(VIEWS)], tiny.cameras(VIEWS))
    content |= {"camera_model": "OPENCV", "fl_x": 36.0, "fl_y": 36.0, "cx": 16.0, "cy": 16.0}
    content |= {"w": 32, "h": 32, "k1": -0.1, "k2": 0.01, "p1": 0.001, "p2": 0.0}
    content["frames"][1] |= {"camera_model": "OPENCV_FISHEYE", "k1": 0.02, "mask_path": "m.png"}
    return json.dumps(content).encode()


def _camera_path() -> bytes:
    frames = tiny.transforms(["a", "b"], tiny.cameras(2))["frames"]
    path = [
        {"camera_to_world": [*chain(*frame["transform_matrix"])], "fov": 50.0, "aspect": 1.0}
        for frame in frames
    ]
    return json.dumps({"camera_path": path, "render_width": 32, "render_height": 32}).encode()


_POINTS = [(0.0, 1.0, 0.5), (1.0, 0.0, 0.2), (2.0, 2.0, 0.1), (-1.0, 0.5, 0.9), (0.3, -2.0, 0.4)]
_TEXT = "".join(f"{i} {x} {y} {z} 1 2 3 0.5\n" for i, (x, y, z) in enumerate(_POINTS)).encode()


def _row(point: tuple[float, ...]) -> bytes:
    """A point of COLMAP's that one image saw."""
    return struct.pack("<Q3d3BdQii", 1, *point, 1, 2, 3, 0.5, 1, 1, 2)


@cache
def good() -> dict[str, dict[str, bytes]]:
    """Files by reader and name; the same whenever they are made."""
    with tempfile.TemporaryDirectory() as name, torch.random.fork_rng():
        torch.manual_seed(0)
        folder = Path(name)
        binary, text = _scene(folder, binary=True), _scene(folder, binary=False)
        return {
            "ply": {
                "binary.ply": model(),
                "degree1.ply": model(1),
                "more-body-than-head.ply": model(count=40),
                "text.ply": _as(model(), text=True),
                "big-endian.ply": _as(model(), byte_order=">"),
            },
            **_formats(folder),
            "sidecar": {"a.safetensors": _sidecar(folder)},
            "cameras.bin": {"a.bin": binary["cameras.bin"]},
            "images.bin": {"a.bin": binary["images.bin"]},
            "points3D.bin": {
                "a.bin": b"".join([struct.pack("<Q", len(_POINTS)), *map(_row, _POINTS)])
            },
            "points3D.txt": {"a.txt": _TEXT},
            "cameras.txt": {"a.txt": text["cameras.txt"], "lenses.txt": _LENSES},
            "images.txt": {"a.txt": text["images.txt"]},
            "transforms": {
                "a.json": _transforms(),
                "nerfstudio.json": _nerfstudio(),
                "camera-path.json": _camera_path(),
            },
            "cameras.json": {"a.json": _cameras()},
            "record": {"a.json": _record(folder)},
            "image": {
                "a.png": _image("PNG"),
                "alpha.png": _image("PNG", "RGBA"),
                "a.jpg": _image("JPEG"),
                "a.webp": _image("WEBP"),
                "a.tiff": _image("TIFF"),
            },
            "mask": {"a.png": _image("PNG"), "alpha.png": _image("PNG", "RGBA")},
            "settings": {"a.toml": _SETTINGS},
            "checkpoint": {"a.pth": _checkpoint(folder)},
            "progress": {"a.safetensors": _progress(folder)},
            "source": {"renderer.py": (HOST / "gaussian_renderer/__init__.py").read_bytes()},
            "git": {"head": b"ref: refs/heads/main\n", "commit": b"0123456789abcdef" * 2 + b"\n"},
            "config": {"a.json": b'{"iterations": 30000, "source_path": "scene", "lambda": 0.2}'},
            "cfg_args": {"a.txt": _ARGUMENTS},
        }
