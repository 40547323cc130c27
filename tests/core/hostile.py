"""Hostile parts of files."""

import io
import math
import os
import struct
import zlib
from collections.abc import Callable
from pathlib import Path
from typing import Any

import torch
from finetune import tiny
from PIL import Image

NAN, INF = math.nan, math.inf

EYE = torch.eye(4).tolist()


def header(*lines: str, start: str = "ply\nformat binary_little_endian 1.0\n") -> bytes:
    """The header of a PLY."""
    return (start + "\n".join(lines) + "\nend_header\n").encode()


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


def camera_entry() -> dict[str, Any]:
    """A good entry of a cameras.json."""
    return tiny.host_cameras(tiny.cameras(1))[0]


def png(width: int, height: int) -> bytes:
    """A PNG of some 70 bytes that says that it is so large."""
    out = io.BytesIO()
    Image.new("RGB", (1, 1)).save(out, format="PNG")
    content = bytearray(out.getvalue())
    content[16:24] = struct.pack(">II", width, height)
    content[29:33] = struct.pack(">I", zlib.crc32(content[12:29]))
    return bytes(content)


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
