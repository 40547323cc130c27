"""GLB with ``KHR_gaussian_splatting``: one primitive of points, all values float32.

glTF has its y axis up and z forward, so x and y change their signs. Thresholds are an attribute of
an extension of ours (docs/reference/cutoff.md).
"""

from __future__ import annotations

import json
import struct
from itertools import chain
from typing import Any, BinaryIO

import numpy as np
import numpy.typing as npt
import torch

from fragprune_plugins.constants import VERSION
from fragprune_plugins.files.model import Model
from fragprune_plugins.files.reading import MEBIBYTE, Reading, parse_json
from fragprune_plugins.workbench.models.formats import Format, arrays

BASE = "KHR_gaussian_splatting"
CUTOFF = "FRAGPRUNE_gaussian_splatting_cutoff"
_THRESHOLD = f"{CUTOFF}:THRESHOLD"
_AXES = (-1, -1, 1)  # the PLY's to glTF's, and back
_JSON, _BIN, _MAGIC = 0x4E4F534A, 0x004E4942, 0x46546C67
_JSON_MAX = 16 * MEBIBYTE
_POINTS, _FLOAT, _UBYTE, _ARRAY_BUFFER = 0, 5126, 5121, 34962
_KINDS = {5120: ("i1", 127), 5121: ("u1", 255), 5122: ("<i2", 32767), 5123: ("<u2", 65535)}
_WIDTHS = {"SCALAR": 1, "VEC3": 3, "VEC4": 4}
_SH = [f"{BASE}:SH_DEGREE_{l}_COEF_{n}" for l in range(4) for n in range(2 * l + 1)]  # noqa: E741


def read(reading: Reading) -> Model:
    """The Gaussians of the file's one primitive of splats."""
    magic, version, _ = struct.unpack("<III", reading.take(12))
    if magic != _MAGIC or version != 2:
        raise ValueError("it does not begin with 'glTF' and version 2")
    length, kind = struct.unpack("<II", reading.take(8))
    if kind != _JSON or length > _JSON_MAX:
        raise ValueError("no JSON in its first chunk")
    scene = parse_json(reading.take(length).decode("utf-8"))
    length, kind = struct.unpack("<II", reading.take(8))
    if kind != _BIN:
        raise ValueError("no binary in its second chunk")
    primitive = _primitive(scene)
    attributes = primitive["attributes"]
    data = reading.take(length)

    def column(name: str, width: int) -> npt.NDArray[Any]:
        reading.place = f"attribute {name}"
        return _accessor(scene, data, attributes[name], width)

    sh = [name for name in _SH if name in attributes]
    if len(sh) - 1 not in arrays.SH_RESTS or sh != _SH[: len(sh)]:
        raise ValueError("SH of a degree that is not whole")
    xyz = column("POSITION", 3)
    names = [(f"{BASE}:ROTATION", 4), (f"{BASE}:SCALE", 3), (f"{BASE}:OPACITY", 1)]
    parts = [column(*each) for each in names] + [column(name, 3) for name in sh]
    ours: dict[str, Any] = primitive["extensions"][BASE].get("extensions", {})
    rules = ours.get(CUTOFF, {})
    cut = CUTOFF in ours and ("stop" not in rules or _THRESHOLD in attributes)
    cutoff = column(_THRESHOLD, 1)[:, 0] if cut else None
    reading.place = ""
    if any(len(part) != len(xyz) for part in (*parts, *(() if cutoff is None else (cutoff,)))):
        raise ValueError("attributes of different lengths")
    rotation, scale, opacity, base, *rest = parts
    splat = arrays.splat_of(
        xyz=xyz,
        colours=base,
        rest=np.stack(rest, axis=1) if rest else np.zeros((len(xyz), 0, 3)),
        opacities=opacity[:, 0],
        log_scales=arrays.logs_of(scale),
        rotations=rotation[:, [3, 0, 1, 2]],
        thresholds=None if cutoff is None else torch.from_numpy(cutoff.copy()),
        stop=rules.get("stop"),
        rim=rules.get("rim", "hard"),
    )
    return arrays.turned(splat, _AXES)


def _primitive(scene: dict[str, Any]) -> dict[str, Any]:
    """The one primitive of splats; it has to be where its node puts it by default."""
    every = chain.from_iterable(mesh["primitives"] for mesh in scene["meshes"])
    found = [each for each in every if BASE in each.get("extensions", {})]
    if len(found) != 1:
        raise ValueError(f"{len(found)} primitives of splats, where we read one")
    primitive: dict[str, Any] = found[0]
    kernel = primitive["extensions"][BASE].get("kernel")
    if kernel != "ellipse" or primitive.get("mode") != _POINTS:
        raise ValueError(f"kernel {kernel!r}, where we draw 'ellipse' on points")
    moved = {"matrix", "rotation", "translation", "scale"}
    if any(moved & each.keys() for each in scene.get("nodes", [])):
        raise ValueError("nodes that move the splats, where we read those that stay")
    return primitive


def _accessor(
    scene: dict[str, Any], data: bytes, index: int, width: int
) -> npt.NDArray[np.float32]:
    """The numbers of an accessor (N, width)."""
    accessor = scene["accessors"][index]
    view = scene["bufferViews"][accessor["bufferView"]]
    if min(index, accessor["bufferView"]) < 0:
        raise ValueError("negative numbers")
    kind, count = accessor["componentType"], accessor["count"]
    code, most = _KINDS[kind] if kind != _FLOAT else ("<f4", 1)
    if _WIDTHS[accessor["type"]] != width or "sparse" in accessor or view.get("buffer") != 0:
        raise ValueError(f"an accessor of type {accessor['type']}, where {width} numbers belong")
    size = np.dtype(code).itemsize
    stride = view.get("byteStride", width * size)
    first = view.get("byteOffset", 0) + accessor.get("byteOffset", 0)
    if min(count, first, stride - width * size) < 0:
        raise ValueError("negative numbers")
    if count and first + stride * (count - 1) + width * size > len(data):
        raise EOFError(f"{count} rows of {stride} bytes at {first}, in {len(data)} bytes")
    rows = np.ndarray((count, width), code, data, first, (stride, size)).astype(np.float32)
    if accessor.get("normalized") and kind != _FLOAT:
        rows = np.maximum(rows / np.float32(most), -1)
    return rows


def write(file: BinaryIO, splat: Model) -> None:
    """Write one primitive; the extension is there only with thresholds or a stop."""
    splat = arrays.turned(splat, _AXES)
    xyz, dc, rest = map(arrays.array, (splat.xyz, splat.f_dc, splat.f_rest))
    base, opacity = dc[:, 0], arrays.opacities_of(splat)
    rgba = arrays.byte(255 * np.column_stack([np.clip(0.5 + arrays.SH_C0 * base, 0, 1), opacity]))
    columns = {
        "POSITION": xyz,
        "COLOR_0": rgba,
        f"{BASE}:ROTATION": arrays.quaternions_of(splat)[:, [1, 2, 3, 0]],
        f"{BASE}:SCALE": np.exp(arrays.array(splat.scaling)),
        f"{BASE}:OPACITY": opacity[:, None],
        **dict(zip(_SH, [base, *rest.transpose(1, 0, 2)], strict=False)),
    }
    extension: dict[str, Any] = {"kernel": "ellipse", "colorSpace": "srgb_rec709_display"}
    extension |= {"sortingMethod": "cameraDistance", "projection": "perspective"}
    used = [BASE]
    if (falloff := splat.falloff) is not None:
        columns[_THRESHOLD] = arrays.array(falloff)[:, None]
    if splat.pruned:
        extension["extensions"] = {CUTOFF: arrays.rules_of(splat)}
        used.append(CUTOFF)
    views: list[dict[str, Any]] = []
    accessors: list[dict[str, Any]] = []
    at, kinds = 0, {width: name for name, width in _WIDTHS.items()}
    for number, values in enumerate(columns.values()):
        place = {"buffer": 0, "byteOffset": at, "byteLength": values.nbytes}
        views.append(place | {"target": _ARRAY_BUFFER})
        kind = _UBYTE if values.dtype == np.uint8 else _FLOAT
        rows = {"count": len(values), "type": kinds[values.shape[1]]}
        accessors.append({"bufferView": number, "componentType": kind, **rows})
        at += values.nbytes
    accessors[0] |= {"min": xyz.min(axis=0).tolist(), "max": xyz.max(axis=0).tolist()}
    accessors[1]["normalized"] = True
    attributes = {name: index for index, name in enumerate(columns)}
    primitive = {"attributes": attributes, "mode": _POINTS, "extensions": {BASE: extension}}
    scene = {
        "asset": {"version": "2.0", "generator": f"fragprune {VERSION}"},
        "extensionsUsed": used,
        "scene": 0,
        "scenes": [{"nodes": [0]}],
        "nodes": [{"mesh": 0}],
        "buffers": [{"byteLength": at}],
        "bufferViews": views,
        "accessors": accessors,
        "meshes": [{"primitives": [primitive]}],
    }
    head = json.dumps(scene, separators=(",", ":")).encode()
    head += b" " * (-len(head) % 4)
    file.write(struct.pack("<IIIII", _MAGIC, 2, 28 + len(head) + at, len(head), _JSON) + head)
    file.write(struct.pack("<II", at, _BIN))
    for values in columns.values():
        file.write(np.ascontiguousarray(values, values.dtype.newbyteorder("<")).tobytes())


FORMAT = Format("GLB", ".glb", read, write, thresholds="as float32", keeps="all values as float32")
