"""Both ways through ``@playcanvas/splat-transform``, the converter that others use.

It is installed from npm into a temporary folder, or found in $FRAGPRUNE_NPM.
"""

import os
import shutil
import subprocess
from dataclasses import replace
from pathlib import Path

import pytest
import torch
from campaigns.fuzz.seeds import spz_parts
from finetune import tiny
from formats.scenes import apart, random_splat

from fragprune_plugins import load, save
from fragprune_plugins.workbench.models import formats
from fragprune_plugins.workbench.models.formats.ply import write_ply

pytestmark = [pytest.mark.npm, pytest.mark.timeout(600)]

PACKAGE = "@playcanvas/splat-transform@3.7.0"
SAME = 3e-5  # both read the same bytes: what is left is float32, and logits near 0 and 1


@pytest.fixture(scope="module")
def convert(tmp_path_factory):
    folder = Path(os.environ.get("FRAGPRUNE_NPM") or tmp_path_factory.mktemp("npm"))
    program = folder / "node_modules" / ".bin" / "splat-transform"
    if not program.exists():
        if shutil.which("npm") is None:
            pytest.skip("npm is absent")
        words = ["npm", "install", "--prefix", str(folder), "--no-audit", "--no-fund", PACKAGE]
        done = subprocess.run(words, capture_output=True, text=True, timeout=300)
        if done.returncode:
            pytest.skip(f"npm installs nothing here: {done.stderr[-200:]}")

    def run(source: Path, target: Path) -> Path:
        words = [str(program), "-g", "cpu", "-i", "2", "-w", str(source), str(target)]
        done = subprocess.run(words, capture_output=True, text=True, timeout=300)
        assert done.returncode == 0, done.stdout + done.stderr
        return target

    return run


@pytest.fixture(scope="module")
def splat():
    return random_splat(1500, 1, 11)


def expect_same(one, other):
    found = apart(one, other)
    assert all(value < SAME * (100 if name == "xyz" else 1) for name, value in found.items()), found


@pytest.mark.parametrize("thresholds", [False, True], ids=["plain", "cut"])
@pytest.mark.parametrize("suffix", [".ply", ".spz", ".sog", ".compressed.ply", ".splat"])
def test_it_reads_what_we_write(convert, splat, suffix, thresholds, tmp_path):
    ours, theirs = tmp_path / f"ours{suffix}", tmp_path / "theirs.ply"
    cut = tiny.cut(splat, torch.linspace(0.01, 0.9, len(splat)))
    if suffix in (".compressed.ply", ".splat") and thresholds:
        pytest.skip("holds no thresholds")
    form = formats.named(ours)
    formats.write(form, ours, cut if thresholds else splat)
    back = load(convert(ours, theirs))
    expected = load(ours)
    assert len(back) == len(splat)
    if suffix == ".splat":  # it reads 128 as 0.004, where the writers of the format put 0
        assert apart(back, expected)["shape"] < 0.03
        back = replace(back, rotation=expected.rotation)
    expect_same(back, expected)


@pytest.mark.parametrize("suffix", [".spz", ".sog", ".compressed.ply"])
def test_we_read_what_it_writes_as_it_does(convert, splat, suffix, tmp_path):
    write_ply(tmp_path / "a.ply", splat)
    theirs = convert(tmp_path / "a.ply", tmp_path / f"a{suffix}")
    again = convert(theirs, tmp_path / "again.ply")
    expect_same(load(theirs), load(again))
    assert load(theirs).thresholds is None


def test_we_read_its_glb_as_the_model_it_was_made_from(convert, splat, tmp_path):
    write_ply(tmp_path / "a.ply", splat)
    expect_same(load(convert(tmp_path / "a.ply", tmp_path / "a.glb")), splat)


def test_without_thresholds_an_spz_is_what_niantics_writer_makes(convert, splat, tmp_path):
    write_ply(tmp_path / "a.ply", splat)
    save(tmp_path / "ours.spz", splat)
    theirs = convert(tmp_path / "a.ply", tmp_path / "theirs.spz").read_bytes()
    ours = (tmp_path / "ours.spz").read_bytes()
    assert ours[:32] == theirs[:32]
    assert spz_parts(ours)[1] == spz_parts(theirs)[1]
