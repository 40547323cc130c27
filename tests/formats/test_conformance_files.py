"""The conformance files, and our own engine against them."""

import json

import cutoff_files
import numpy as np
import pytest
import torch
from cutoff_files import FRAGMENTS, PSNR_MIN
from PIL import Image

from fragprune_plugins import RasterInputs, load, load_cameras
from fragprune_plugins.engines import create_engine
from fragprune_plugins.workbench.figures.metrics import psnr
from fragprune_plugins.workbench.models.cutoffs import encode


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    out = tmp_path_factory.mktemp("conformance")
    cutoff_files.write(out)
    return out


@pytest.fixture(scope="module")
def said(folder):
    content = json.loads((folder / "cutoffs.json").read_text())
    listed = folder / "cameras.json"
    listed.write_text(json.dumps(content["cameras"]))
    return content | {"views": dict(load_cameras(listed))}


def expected(path):
    return torch.from_numpy(np.asarray(Image.open(path)) / np.float32(255)).permute(2, 0, 1)


def drawn(path, view):
    model = load(path)
    inputs = RasterInputs(view, model.splats(), planes=())
    with torch.no_grad():
        out = create_engine("cpu").rasterize(inputs, model.falloff)
    return out.image.clamp(0, 1), float(out.fragments_per_pixel)


@pytest.mark.parametrize("scene", cutoff_files.SCENES)
def test_our_engine_draws_every_carrier_as_expected(folder, said, scene):
    for name in said["scenes"][scene]["files"]:
        for view, of in said["scenes"][scene]["views"].items():
            image, fragments = drawn(folder / name, said["views"][view])
            assert psnr(image, expected(folder / of["picture"])) > PSNR_MIN, (name, view)
            assert fragments == pytest.approx(of["fragments_per_pixel"], rel=FRAGMENTS)


@pytest.mark.parametrize("scene", cutoff_files.SCENES)
def test_a_renderer_that_ignores_cutoffs_fails(folder, said, scene):
    for view, of in said["scenes"][scene]["views"].items():
        plain = folder / said["scenes"][scene]["file_without_cutoffs"]
        image, fragments = drawn(plain, said["views"][view])
        assert psnr(image, expected(folder / of["picture"])) < PSNR_MIN - 10
        assert fragments > (1 + 5 * FRAGMENTS) * of["fragments_per_pixel"]
        ignored = of["without_cutoffs"]
        assert psnr(image, expected(folder / ignored["picture"])) > PSNR_MIN
        assert fragments == pytest.approx(ignored["fragments_per_pixel"], rel=FRAGMENTS)


@pytest.mark.parametrize("scene", cutoff_files.SCENES)
def test_codes_are_listed_in_the_order_of_rows(folder, said, scene):
    codes = said["scenes"][scene]["codes"]
    for suffix in (".ply", ".spz", ".glb"):
        assert encode(load(folder / f"{scene}{suffix}").falloff).tolist() == codes


def test_the_same_files_come_out_again(folder, tmp_path):
    cutoff_files.write(tmp_path)
    files = sorted(path.name for path in tmp_path.iterdir())
    assert len(files) == 3 * (5 + 4) + 1
    for name in files:
        assert (tmp_path / name).read_bytes() == (folder / name).read_bytes(), name
