"""Loading and saving a model from Python."""

from __future__ import annotations

import pytest
import torch
from cli.commands import run_json
from finetune import tiny

import fragprune_plugins as fp
from fragprune_plugins.errors import OutputError, SidecarError
from fragprune_plugins.files import sidecar


@pytest.fixture
def model():
    return tiny.cut(tiny.random_model(), torch.linspace(0.01, 0.5, 60))


def test_what_was_saved_comes_back(model, tmp_path):
    beside = fp.save(str(tmp_path / "a.ply"), model)
    assert beside == tmp_path / "a.fragprune.safetensors"
    read = tiny.state(fp.load(str(tmp_path / "a.ply")))
    assert all(torch.equal(each, read[name]) for name, each in tiny.state(model).items())
    assert fp.load(tmp_path / "a.ply", truncation=False).thresholds is None


def test_others_may_read_what_a_plain_open_lets_them(model, tmp_path):
    (tmp_path / "plain").write_text("")
    beside = fp.save(tmp_path / "a.ply", model)
    for path in (tmp_path / "a.ply", beside):
        assert path.stat().st_mode == (tmp_path / "plain").stat().st_mode


def test_a_model_without_thresholds_replaces_one_with_them(model, tmp_path):
    fp.save(tmp_path / "a.ply", model)
    fp.save(tmp_path / "a.ply", model.untruncated())
    assert fp.load(tmp_path / "a.ply").thresholds is None


def test_the_pair_is_the_one_that_the_command_line_writes(tmp_path):
    data, path, _ = tiny.scene(tmp_path)
    out, again = tmp_path / "out.ply", tmp_path / "again.ply"
    report = run_json("finetune", path, "--data", data, "--out", out, "--iters", 3)
    fp.save(again, fp.load(out), settings=report["settings"])
    assert again.read_bytes() == out.read_bytes()
    (ours, said), (theirs, told) = sidecar.load(again), sidecar.load(out)
    assert said == told
    assert all(map(torch.equal, ours.numbers.values(), theirs.numbers.values()))


def test_the_sidecar_says_that_it_belongs_to_the_file(model, tmp_path):
    fp.save(tmp_path / "a.ply", model)
    sidecar.path_beside(tmp_path / "a.ply").unlink()
    with pytest.raises(SidecarError, match="no such file"):
        fp.load(str(tmp_path / "a.ply"))


def test_what_cannot_be_saved_leaves_nothing(model, tmp_path):
    with pytest.raises(OutputError):
        fp.save(tmp_path / "a.png", model)
    assert list(tmp_path.iterdir()) == []
