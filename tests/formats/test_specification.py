"""Readers made from docs/reference/cutoff.md alone find what we write, where the page says."""

import io
import json
import re
import struct
import zipfile
from pathlib import Path

import numpy as np
import pytest
import torch
from finetune import tiny
from formats.scenes import random_splat
from PIL import Image

from fragprune_plugins import load, save
from fragprune_plugins.workbench.models import cutoffs
from fragprune_plugins.workbench.models.formats.ply import write_ply

PAGE = (Path(__file__).parents[2] / "docs/reference/cutoff.md").read_text(encoding="utf-8")
COUNT = 30


@pytest.fixture
def model():
    pruned = tiny.cut(random_splat(COUNT, 1, 0), torch.linspace(0.01, 0.95, COUNT))
    return pruned.with_rules(stop=0.02)


@pytest.fixture
def codes(model):
    return cutoffs.encode(model.thresholds.values.detach()).tolist()


def test_ply_column(model, tmp_path):
    write_ply(tmp_path / "a.ply", model)
    head, body = (tmp_path / "a.ply").read_bytes().split(b"end_header\n")
    names = re.findall(rb"property float (\w+)", head)
    assert names[-1] == b"trunc_threshold"
    rows = np.frombuffer(body, "<f4").reshape(COUNT, -1)
    assert rows[:, -1].tolist() == model.thresholds.values.tolist()
    (comment,) = re.findall(r"^    (comment .*)", PAGE, re.M)
    assert head.decode().splitlines()[3] == comment
    write_ply(tmp_path / "a.ply", model.with_rules(rim="soft"))
    (comment,) = re.findall(r"`(comment .*)`", PAGE)
    assert (tmp_path / "a.ply").read_bytes().splitlines()[4].decode() == comment


def test_spz_record(model, codes, tmp_path):
    save(tmp_path / "a.spz", model)
    content = (tmp_path / "a.spz").read_bytes()
    kind = int(re.search(r"u32 \| (0x\w+):", PAGE)[1], 16)
    assert content[14] & 0x2
    assert struct.unpack_from("<II", content, 32) == (kind, COUNT)
    assert list(content[40 : 40 + COUNT]) == codes
    kind = int(re.search(r"type (0x\w+), length 4", PAGE)[1], 16)
    assert struct.unpack_from("<IIf", content, 40 + COUNT) == (kind, 4, pytest.approx(0.02))
    assert struct.unpack_from("<I", content, 16)[0] == 40 + COUNT + 12
    save(tmp_path / "soft.spz", model.with_rules(rim="soft"))
    kind = int(re.search(r"type (0x\w+), length 0", PAGE)[1], 16)
    content = (tmp_path / "soft.spz").read_bytes()
    assert struct.unpack_from("<II", content, 40 + COUNT + 12) == (kind, 0)


def test_sog_image(model, tmp_path):
    save(tmp_path / "a.sog", model)
    with zipfile.ZipFile(tmp_path / "a.sog") as archive:
        extras = json.loads(archive.read("meta.json"))["extras"]
        images = {
            name: Image.open(io.BytesIO(archive.read(name)))
            for name in ("means_l.webp", extras["fragprune_cutoff"]["files"][0])
        }
    assert extras == json.loads("{" + re.search(r'"extras": .*', PAGE)[0] + "}")["extras"]
    means, plane = images.values()
    assert plane.size == means.size
    texels = np.asarray(plane.convert("RGBA")).reshape(-1, 4)[:COUNT]
    assert (texels[:, 0] == texels[:, 1]).all()
    assert (texels[:, 3] == 255).all()
    stored = load(tmp_path / "a.sog").thresholds.values.detach()
    assert texels[:, 0].tolist() == cutoffs.encode(stored).tolist()


def test_glb_attribute(model, tmp_path):
    save(tmp_path / "a.glb", model)
    content = (tmp_path / "a.glb").read_bytes()
    (length,) = struct.unpack_from("<I", content, 12)
    scene, data = json.loads(content[20 : 20 + length]), content[28 + length :]
    name = re.search(r'"(\w+):THRESHOLD"', PAGE)[1]
    assert name in scene["extensionsUsed"]
    assert "extensionsRequired" not in scene
    primitive = scene["meshes"][0]["primitives"][0]
    assert primitive["extensions"]["KHR_gaussian_splatting"]["extensions"] == {
        name: json.loads(re.search(r"object, `(.*?)`", PAGE.replace("\n", " "))[1])
    }
    accessor = scene["accessors"][primitive["attributes"][f"{name}:THRESHOLD"]]
    assert (accessor["type"], accessor["componentType"], accessor["count"]) == ("SCALAR", 5126, 30)
    view = scene["bufferViews"][accessor["bufferView"]]
    stored = np.frombuffer(data, "<f4", COUNT, view["byteOffset"])
    assert stored.tolist() == model.thresholds.values.tolist()


@pytest.mark.parametrize("language", ["glsl", "wgsl"])
def test_shaders_decode_as_python_does(language):
    shader = re.search(rf"```{language}\n(.*?)```", PAGE, re.S)[1]
    number = float(re.search(r"256u - code\) \* ([\d.]+)", shader)[1])
    decoded = -2 * np.log(cutoffs.decode(np.arange(256, dtype=np.uint8)).astype(float))
    np.testing.assert_allclose((256 - np.arange(256)) * number, decoded, rtol=1e-5)
