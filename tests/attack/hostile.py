"""Hostile files of every kind, by name: each has to be refused, unless it says that it is good."""

from __future__ import annotations

import io
import json
import math
import os
import struct
import zlib
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import torch
from finetune import tiny
from PIL import Image
from safetensors import safe_open
from safetensors.torch import load_file, save_file

from fragprune_plugins.files import sidecar
from fragprune_plugins.files.ply import write_ply
from fragprune_plugins.learning.thresholds import ThresholdStore

GOOD = "good: "
"""Begins the names of files that have to be read."""

NAN, INF = math.nan, math.inf
EYE = torch.eye(4).tolist()

# -- PLY -----------------------------------------------------------------------------------------


def header(*lines: str, start: str = "ply\nformat binary_little_endian 1.0\n") -> bytes:
    """The header of a PLY."""
    return (start + "\n".join(lines) + "\nend_header\n").encode()


def plies(folder: Path) -> dict[str, bytes]:
    """PLY files."""
    path = folder / "seed.ply"
    write_ply(path, tiny.random_model(40, degree=1))
    good = path.read_bytes()
    size = good.index(b"end_header\n") + len(b"end_header\n")
    text = "ply\nformat ascii 1.0\n"

    def spoiled(part: str, value: float, rows: tuple[int, ...] = (3, 7)) -> bytes:
        model = tiny.random_model(40, degree=1)
        getattr(model, part)[list(rows)] = value
        write_ply(path, model)
        return path.read_bytes()

    def headed(old: str, new: str) -> bytes:
        return good.replace(old.encode(), new.encode(), 1)

    def before(lines: str) -> bytes:
        return headed("element vertex", lines + "\nelement vertex")

    def commented(words: bytes, times: int = 1) -> bytes:
        return good.replace(b"\nelement", b"\ncomment " * times + words + b"\nelement", 1)

    columns = "".join(f"property float c{i}\n" for i in range(100_000))
    return {
        GOOD + "as it is": good,
        GOOD + "more bytes than rows": good + bytes(100),
        GOOD + "carriage returns": good[:size].replace(b"\n", b"\r\n") + good[size:],
        GOOD + "a comment that is no text": good.replace(
            b"\nelem", b"\ncomment \xff\x1b[2J\nelem", 1
        ),
        "nothing": b"",
        "one byte": b"p",
        "zeros": bytes(5000),
        "a picture": png(8, 8),
        "header alone": good[:size],
        "half a row less": good[: len(good) - 30],
        "half a header": good[: size // 2],
        "rows 2^63": headed("vertex 40", f"vertex {2**63}"),
        "rows 2^62": headed("vertex 40", f"vertex {2**62}"),
        "rows 2^31 in text": header(f"element vertex {2**31}", "property float x", start=text),
        "rows negative": headed("vertex 40", "vertex -40"),
        "rows of 5,000 digits": headed("vertex 40", "vertex " + "9" * 5000),
        "no rows": headed("vertex 40", "vertex 0"),
        "rows NaN": headed("vertex 40", "vertex nan"),
        "a column twice": headed("property float y", "property float x"),
        "a column less": headed("property float rot_3\n", ""),
        "a list": headed("property float x", "property list uchar float x"),
        "lists before": headed(
            "element vertex", "element a 9\nproperty list int int b\nelement vertex"
        ),
        "giant elements before": headed(
            "element vertex", f"element a {2**60}\nproperty int b\nelement vertex"
        ),
        "f_rest of 5,000 digits": headed("f_rest_3", "f_rest_" + "9" * 5000),
        "f_rest twice as many": headed("f_rest_8", "f_rest_9"),
        "an unknown type": headed("float x", "float128 x"),
        "an unknown word": headed("element", "elephant"),
        "no format": headed("format binary_little_endian 1.0\n", ""),
        "another format": headed("little_endian 1.0", "middle_endian 2.0"),
        "no vertex": headed("element vertex", "element edge"),
        "a comment of 30 MB": good.replace(
            b"\nelement", b"\ncomment " + b"x" * 30_000_000 + b"\nelement", 1
        ),
        "3 million comments": good.replace(
            b"\nelement", b"\ncomment x" * 3_000_000 + b"\nelement", 1
        ),
        "100,000 columns": headed("end_header", columns + "end_header"),
        "text that is no number": header("element vertex 1", "property float x", start=text)
        + b"one",
        **{f"{part} {value}": spoiled(part, value) for part in PARTS for value in (NAN, INF)},
        "a scale of e^44": spoiled("scaling", 44.0),
        "a scale of e^88": spoiled("scaling", 88.0),
        "quaternions 0": spoiled("rotation", 0.0),
        "quaternions 1e-30": spoiled("rotation", 1e-30),
        "quaternions 1e30": spoiled("rotation", 1e30),
        "a zip": b"PK\x03\x04" + bytes(200),
    }


PARTS = ("xyz", "f_dc", "f_rest", "opacity", "scaling", "rotation")

# -- sidecars ------------------------------------------------------------------------------------


def sidecars(model: Path) -> dict[str, bytes]:
    """Sidecars of a model file of 40 Gaussians."""
    store = ThresholdStore(40)
    store.open(torch.full((40,), 0.5))
    store.logits.grad = torch.ones(40)
    store.step(0.1)
    path = sidecar.save(model, store)
    good, tensors = path.read_bytes(), load_file(path)
    with safe_open(path, framework="pt") as file:
        said = file.metadata()

    def other(metadata: dict[str, str] | None = None, **changed: torch.Tensor | None) -> bytes:
        kept = {k: v for k, v in (tensors | changed).items() if v is not None}
        save_file(kept, path, metadata=said | (metadata or {}))
        return path.read_bytes()

    def spoiled(name: str, value: float) -> bytes:
        rows = tensors[name].clone()
        rows[5] = value
        return other(**{name: rows})

    found = {
        GOOD + "as it is": good,
        GOOD + "one tensor more": other(extra=torch.zeros(3)),
        "nothing": b"",
        "half": good[: len(good) // 2],
        "a header of 2^60 bytes": struct.pack("<Q", 1 << 60) + good[8:],
        "a header of nested brackets": struct.pack("<Q", 200_000) + b"[" * 200_000,
        "a header that is no JSON": struct.pack("<Q", 9) + b"{{{{{{{{{",
        "another model": other({"model_sha256": "0" * 64}),
        "another format": other({"format": "x\x1b[2J"}),
        "rows 1": other({"rows": "1"}),
        "rows 2^62": other({"rows": str(1 << 62)}),
        "rows of 5,000 digits": other({"rows": "9" * 5000}),
        "steps -1": other({"steps": "-1"}),
        "adam_step NaN": other({"adam_step": "nan"}),
        "settings nested": other({"settings": "[" * 100_000}),
        "settings a list": other({"settings": "[1]"}),
        "no logits": other(logits=None),
        "logits of 1 row": other(**{k: v[:1].clone() for k, v in tensors.items()}),
        "logits of 39 rows": other(**{k: v[1:].clone() for k, v in tensors.items()}),
        "moments of 39 rows": other(exp_avg=tensors["exp_avg"][1:].clone()),
        "logits in rows and columns": other(logits=torch.zeros(40, 1)),
        **{f"all {kind}"[:4] + str(kind)[6:]: other(**_as(tensors, kind)) for kind in _KINDS},
        **{f"{name} {value}": spoiled(name, value) for name in tensors for value in _ENDS},
        "second moments negative": spoiled("exp_avg_sq", -1.0),
    }
    path.unlink()
    return found


_ENDS = (NAN, INF, -INF)
_KINDS = (
    *(torch.int32, torch.bool, torch.float64, torch.float16, torch.bfloat16, torch.complex64),
)


def _as(tensors: dict[str, torch.Tensor], kind: torch.dtype) -> dict[str, torch.Tensor]:
    return {name: tensor.to(kind) for name, tensor in tensors.items()}


# -- cameras -------------------------------------------------------------------------------------

GEOMETRY: dict[str, dict[str, Any]] = {
    "focal 0": {"fx": 0.0},
    "focal negative": {"fy": -36.0},
    "focal NaN": {"fx": NAN},
    "focal infinite": {"fx": INF},
    "focal tiny": {"fx": 1e-9},
    "focal huge": {"fx": 1e12},
    "focal a list": {"fx": [36.0]},
    "width 0": {"width": 0},
    "width negative": {"width": -32},
    "width vast": {"width": 10**9},
    "width of 400 digits": {"width": 10**400},
    "width infinite": {"width": INF},
    "width a word": {"width": "wide"},
    "rotation singular": {"rotation": [[1, 0, 0], [0, 1, 0], [0, 0, 0]]},
    "rotation NaN": {"rotation": [[1, 0, 0], [0, NAN, 0], [0, 0, 1]]},
    "rotation scaled": {"rotation": [[2, 0, 0], [0, 2, 0], [0, 0, 2]]},
    "rotation mirrored": {"rotation": [[1, 0, 0], [0, 1, 0], [0, 0, -1]]},
    "rotation ragged": {"rotation": [[1, 0, 0], [0, 1], [0, 0, 1]]},
    "rotation flat": {"rotation": [1, 0, 0, 0, 1, 0, 0, 0, 1]},
    "rotation words": {"rotation": "identity"},
    "position NaN": {"position": [0, NAN, 0]},
    "position far": {"position": [1e30, 0, 0]},
    "position short": {"position": [0, 0]},
    "position none": {"position": None},
}

TRANSFORMS: dict[str, dict[str, Any]] = {
    "w infinite": {"w": INF},
    "w of 5,000 digits": {"w": 10**4000},
    "w 0": {"w": 0},
    "h missing": {"h": None},
    "angle 0": {"camera_angle_x": 0.0},
    "angle NaN": {"camera_angle_x": NAN},
    "angle negative": {"camera_angle_x": -1.0},
    "fl_x negative": {"fl_x": -5},
    "fl_y 0": {"fl_y": 0},
    "cx NaN": {"cx": NAN},
    "cy infinite": {"cy": INF},
    "frames a number": {"frames": 3},
    "frames of numbers": {"frames": [3]},
    "frames missing": {"frames": None},
    "frames empty": {"frames": []},
    "k1 vast": {"k1": 1e9},
    "k5 NaN": {"k5": NAN},
    "p2 a list": {"p2": [0.1]},
    "fisheye, k4 infinite": {"camera_model": "OPENCV_FISHEYE", "k4": INF},
    "a lens of no name": {"camera_model": "EQUIRECTANGULAR"},
}

MATRICES: dict[str, Any] = {
    "matrix of 2 rows": EYE[:2],
    "matrix in a list": [EYE],
    "matrix of 3 columns": [row[:3] for row in EYE],
    "matrix NaN": torch.full((4, 4), NAN).tolist(),
    "matrix 0": torch.zeros(4, 4).tolist(),
    "matrix scaled": (3 * torch.eye(4)).tolist(),
    "matrix 1e300": (1e300 * torch.eye(4).double()).tolist(),
    "matrix of words": [["a"] * 4] * 4,
    "matrix a number": 5,
    "matrix nested 900 deep": json.loads("[" * 900 + "]" * 900),
}

TEXTS = {
    "nothing": b"",
    "no JSON": b"{",
    "not UTF-8": b'{"frames": "\xff\xfe"}',
    "nested 100,000 deep": b"[" * 100_000 + b"]" * 100_000,
    "nested 500 deep": b'{"a":' * 500 + b"1" + b"}" * 500,
    "a number": b"7",
    "a word": b'"cameras"',
    "null": b"null",
    "a list of numbers": b"[1, 2]",
    "an empty list": b"[]",
    "5,000 digits": b"[" + b"9" * 5000 + b"]",
}


def camera_entry() -> dict[str, Any]:
    """A good entry of a cameras.json."""
    camera = tiny.cameras(1)[0]
    return {
        "id": 0,
        "img_name": "a",
        "width": 32,
        "height": 32,
        "position": (-camera.rotation.T @ camera.translation).tolist(),
        "rotation": camera.rotation.T.tolist(),
        "fx": 36.0,
        "fy": 36.0,
    }


def cameras() -> dict[str, bytes]:
    """Files for ``render --cameras``, both kinds."""
    entry = camera_entry()
    found = {GOOD + "cameras.json": json.dumps([entry, entry]).encode()}
    found |= {name: json.dumps([entry, entry | how]).encode() for name, how in GEOMETRY.items()}
    for key in ("img_name", "rotation", "position", "width", "fx"):
        found[f"{key} missing"] = json.dumps(
            [{k: v for k, v in entry.items() if k != key}]
        ).encode()
    found |= TEXTS
    good = tiny.transforms(["a"], tiny.cameras(1)) | {"w": 32, "h": 32}
    found[GOOD + "transforms"] = json.dumps(good).encode()
    for name, how in TRANSFORMS.items():
        changed = {key: value for key, value in (good | how).items() if value is not None}
        with_digits = json.dumps(changed | {"w": 0}).replace('"w": 0', '"w": ' + "9" * 5000)
        text = with_digits if "digits" in name else json.dumps(changed)
        found[f"transforms: {name}"] = text.encode()
    for name, matrix in MATRICES.items():
        frames = [{"file_path": "a", "transform_matrix": matrix}]
        found[f"transforms: {name}"] = json.dumps(good | {"frames": frames}).encode()
    elsewhere = good | {"frames": [good["frames"][0] | {"transform_matrix": far_away()}]}
    found["transforms: a camera that sees nothing"] = json.dumps(elsewhere).encode()
    return found


def far_away() -> list[list[float]]:
    """The pose of a camera that looks away from everything."""
    pose = torch.eye(4)
    pose[2, 3] = -1e4
    return pose.tolist()


# -- COLMAP --------------------------------------------------------------------------------------


def image_record(
    points: int = 0,
    count: int = 1,
    quaternion: tuple[float, ...] = (1, 0, 0, 0),
    name: bytes = b"view00.png\0",
    translation: tuple[float, ...] = (0, 0, 3),
    camera: int = 7,
) -> bytes:
    """An images.bin of one image."""
    pose = struct.pack("<i7di", 1, *quaternion, *translation, camera)
    return struct.pack("<Q", count) + pose + name + struct.pack("<Q", points)


def camera_record(
    code: int = 1,
    size: tuple[int, int] = (32, 32),
    lens: tuple[float, ...] = (36, 36, 16, 16),
    count: int = 1,
) -> bytes:
    """A cameras.bin of one camera."""
    return struct.pack("<QiiQQ", count, 7, code, *size) + struct.pack(f"<{len(lens)}d", *lens)


def among(record: bytes) -> bytes:
    """An images.bin with good images after this one, so that it is not refused for being alone."""
    if record[:8] != struct.pack("<Q", 1):
        return record
    names = (b"view%02d.png\0" % number for number in range(1, 9))
    others = b"".join(image_record(name=name)[8:] for name in names)
    return struct.pack("<Q", 9) + record[8:] + others


COLMAP: dict[str, dict[str, bytes]] = {
    GOOD + "as it is": {"images.bin": image_record()},
    "points 2^40": {"images.bin": image_record(points=1 << 40)},
    "points 2^62": {"images.bin": image_record(points=1 << 62)},
    "images 2^62": {"images.bin": image_record(count=1 << 62)},
    "no image": {"images.bin": struct.pack("<Q", 0)},
    "quaternion 0": {"images.bin": image_record(quaternion=(0, 0, 0, 0))},
    "quaternion NaN": {"images.bin": image_record(quaternion=(NAN, 0, 0, 0))},
    "quaternion 1e300": {"images.bin": image_record(quaternion=(1e300, 1e300, 0, 0))},
    "translation NaN": {"images.bin": image_record(translation=(0, NAN, 0))},
    "translation 1e300": {"images.bin": image_record(translation=(1e300, 0, 0))},
    "a name without end": {"images.bin": image_record(name=b"x" * 5000)},
    "a name of 3,000 letters": {"images.bin": image_record(name=b"x" * 3000 + b"\0")},
    "a name that is no text": {"images.bin": image_record(name=b"\xff\xfe\0")},
    "a name with a line and an escape": {"images.bin": image_record(name=b"a\n\x1b[2J\0")},
    "no name": {"images.bin": image_record(name=b"\0")},
    "a camera that is not there": {"images.bin": image_record(camera=9)},
    "images empty": {"images.bin": b""},
    "cameras empty": {"cameras.bin": b""},
    "cameras 2^62": {"cameras.bin": camera_record(count=1 << 62)},
    "a model 99": {"cameras.bin": camera_record(code=99)},
    "a model with distortion": {"cameras.bin": camera_record(code=4, lens=(36,) * 8)},
    "width 0": {"cameras.bin": camera_record(size=(0, 32))},
    "width 2^63": {"cameras.bin": camera_record(size=(1 << 63, 32))},
    "focal 0": {"cameras.bin": camera_record(lens=(0, 36, 16, 16))},
    "focal NaN": {"cameras.bin": camera_record(lens=(NAN, 36, 16, 16))},
    "focal negative": {"cameras.bin": camera_record(lens=(-36, 36, 16, 16))},
    "centre NaN": {"cameras.bin": camera_record(lens=(36, 36, NAN, 16))},
    "lens cut off": {"cameras.bin": camera_record(lens=(36,))},
}

COLMAP_TEXT: dict[str, dict[str, bytes]] = {
    "words": {"cameras.txt": b"seven PINHOLE 32 32 36 36 16 16\n"},
    "few numbers": {"cameras.txt": b"7 PINHOLE 32 32 36\n"},
    "width 1e9": {"cameras.txt": b"7 PINHOLE 1000000000 32 36 36 16 16\n"},
    "width of 5,000 digits": {"cameras.txt": b"7 PINHOLE " + b"9" * 5000 + b" 32 36 36 16 16\n"},
    "focal nan": {"cameras.txt": b"7 PINHOLE 32 32 nan 36 16 16\n"},
    "not UTF-8": {"cameras.txt": b"\xff\xfe"},
    "only comments": {"cameras.txt": b"# nothing\n"},
    "an image of few numbers": {"images.txt": b"1 1 0 0 0 0 0 3 7\n\n"},
    "an image of words": {"images.txt": b"1 a b c d 0 0 3 7 view00.png\n\n"},
    "a quaternion 0": {"images.txt": b"1 0 0 0 0 0 0 3 7 view00.png\n\n"},
}

# -- images --------------------------------------------------------------------------------------


def png(width: int, height: int) -> bytes:
    """A PNG of some 70 bytes that says that it is so large."""
    out = io.BytesIO()
    Image.new("RGB", (1, 1)).save(out, format="PNG")
    content = bytearray(out.getvalue())
    content[16:24] = struct.pack(">II", width, height)
    content[29:33] = struct.pack(">I", zlib.crc32(content[12:29]))
    return bytes(content)


def images() -> dict[str, bytes]:
    """Photographs of a scene, in place of one."""

    def saved(picture: Image.Image, form: str = "PNG", **how: Any) -> bytes:
        out = io.BytesIO()
        picture.save(out, format=form, **how)
        return out.getvalue()

    plain, size = Image.fromarray(np.zeros((32, 32, 3), np.uint8)), (32, 32)
    good = saved(plain)
    return {
        GOOD + "as it is": good,
        GOOD + "CMYK": saved(Image.new("CMYK", size, (10, 20, 30, 40)), "JPEG"),
        GOOD + "a palette": saved(plain.convert("P"), transparency=0),
        GOOD + "grey and alpha": saved(Image.new("LA", size, (90, 128))),
        GOOD + "one bit": saved(Image.new("1", size, 1)),
        GOOD + "two frames": saved(plain, "WEBP", save_all=True, append_images=[plain]),
        GOOD + "EXIF of nonsense": saved(plain, "JPEG", exif=b"Exif\0\0MM\0*" + b"\xff" * 500),
        "16 bits grey": saved(Image.fromarray(np.full(size, 9000, np.uint16))),
        "32 bits grey": saved(Image.fromarray(np.full(size, 9000, np.int32)), "TIFF"),
        "floats": saved(Image.fromarray(np.full(size, 0.5, np.float32)), "TIFF"),
        "a side of 16 million": png(1 << 24, 8),
        "nothing": b"",
        "half": good[: len(good) // 2],
        "no picture": b"not a picture",
        "60,000 x 60,000 pixels": png(60_000, 60_000),
        "13,000 x 13,000 pixels": png(13_000, 13_000),
        "2^31 x 1 pixels": png(2**31 - 1, 1),
        "0 x 0 pixels": png(0, 0),
        "PostScript": b"%!PS-Adobe-3.0 EPSF-3.0\n%%BoundingBox: 0 0 32 32\n(x) print\n%%EOF\n",
        "a GIF's head": b"GIF89a" + bytes(50),
    }


# -- records -------------------------------------------------------------------------------------


def records(good: dict[str, Any]) -> dict[str, bytes]:
    """Records made from one of a fine-tuning."""

    def other(**changed: Any) -> bytes:
        return json.dumps(good | {"data": good["data"] | changed}).encode()

    photographs = good["data"]["photographs"]
    after = good["data"]["after"]
    return {
        GOOD + "as it is": json.dumps(good).encode(),
        GOOD + "pictures that are elsewhere": other(files=["../../x.png", "/etc/passwd", "\0", ""]),
        **TEXTS,
        "data a list": json.dumps(good | {"data": []}).encode(),
        "command a number": json.dumps(good | {"command": 3}).encode(),
        "data nested": json.dumps(good).encode()[:-1] + b',"x":' + b"[" * 900 + b"]" * 900 + b"}",
        "before a number": other(before=3),
        "after a word": other(after="better"),
        "psnr a word": other(after=after | {"psnr": "high"}),
        "fragments null": other(after=after | {"fragments_per_pixel": None}),
        "frame_ms of 400 digits": other(after=after | {"frame_ms": 10**400}),
        "settings a list": other(settings=[1]),
        "files a number": other(files=7),
        "files of numbers": other(files=[7]),
        "curves of numbers": other(curves=[1, 2]),
        "curves of words": other(curves=[{"step": "a", "loss": {}, "fragments_per_pixel": []}]),
        "iterations a list": other(iterations=[3], adapter="x"),
        "photographs a list": other(photographs=[1]),
        "photographs without models": other(photographs=photographs | {"models": []}),
        "photographs of numbers": other(photographs=photographs | {"folder": 5}),
        "resolution 0": other(photographs=photographs | {"resolution": 0}),
        "resolution a word": other(photographs=photographs | {"resolution": "half"}),
        "drawing an unknown rule": other(photographs=photographs | {"drawing": {"rule": 1}}),
        "drawing dilation NaN": other(photographs=photographs | {"drawing": {"dilation": NAN}}),
    }


# -- sources that check reads --------------------------------------------------------------------


def sources() -> dict[str, dict[str, bytes]]:
    """Files of a host's folder; no adapter may fit, and nothing may be run."""
    run = b"import os\nos.system('touch executed')\n"
    renderer = "gaussian_renderer/__init__.py"
    return {
        "code that runs": {"train.py": run, "setup.py": run, renderer: run, "conftest.py": run},
        "brackets 100,000 deep": {"train.py": b"(" * 100_000 + b")" * 100_000},
        "signs 100,000 deep": {"train.py": b"x = " + b"-" * 100_000 + b"1"},
        "attributes 20,000 deep": {"train.py": b"x" + b".a" * 20_000},
        "additions 50,000 long": {renderer: b"x = 1" + b" + 1" * 50_000},
        "NUL": {"train.py": b"\0\0"},
        "not UTF-8": {"train.py": b"# \xff\xfe\n", ".git/HEAD": b"\xff\xfe\xfd"},
        "HEAD leads out": {".git/HEAD": b"ref: ../../../../../../etc/passwd\n"},
        "HEAD is a text": {".git/HEAD": b"root:x:0:0\x1b[2J\n" * 1000},
        "9 MB of source": {"train.py": b"x = 1\n" * 1_500_000},
        "an import of 300 letters": {"train.py": b"import " + b"x" * 300 + b"\n"},
        "an import of itself": {"train.py": b"import train\nfrom . import train\n"},
        "relative imports too far up": {"train.py": b"from ........ import x\n"},
    }


# -- files that are none -------------------------------------------------------------------------


def special(path: Path, kind: str) -> Path:
    """Something at a path that is no regular file."""
    make: dict[str, Callable[[], Any]] = {
        "pipe": lambda: os.mkfifo(path),
        "folder": lambda: path.mkdir(),
        "device": lambda: path.symlink_to("/dev/zero"),
        "loop": lambda: path.symlink_to(path),
        "dangling": lambda: path.symlink_to(path.with_name("nowhere")),
    }
    make[kind]()
    return path


SPECIAL = ("pipe", "folder", "device", "loop", "dangling")
