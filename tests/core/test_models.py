"""Loading and saving a model from Python."""

from __future__ import annotations

import pytest
import torch
from cli.commands import run_json
from finetune import tiny

import fragprune_plugins as fp
from fragprune_plugins.errors import AlignmentError, OutputError, SidecarError
from fragprune_plugins.files import sidecar


@pytest.fixture
def model():
    splat = tiny.random_model()
    return fp.Model(splat, fp.ThresholdStore.from_falloff(torch.linspace(0.01, 0.5, len(splat))))


def test_what_was_saved_comes_back(model, tmp_path):
    beside = fp.save(str(tmp_path / "a.ply"), model)
    assert beside == tmp_path / "a.fragprune.safetensors"
    splat, thresholds = fp.load(str(tmp_path / "a.ply"))
    for name in ("xyz", "f_dc", "f_rest", "opacity", "scaling", "rotation"):
        assert torch.equal(getattr(splat, name), getattr(model.splat, name))
    assert torch.equal(thresholds.logits, model.thresholds.logits)
    assert fp.load(tmp_path / "a.ply", truncation=False).thresholds is None


def test_others_may_read_what_a_plain_open_lets_them(model, tmp_path):
    (tmp_path / "plain").write_text("")
    beside = fp.save(tmp_path / "a.ply", model)
    for path in (tmp_path / "a.ply", beside):
        assert path.stat().st_mode == (tmp_path / "plain").stat().st_mode


def test_a_model_without_thresholds_replaces_one_with_them(model, tmp_path):
    fp.save(tmp_path / "a.ply", model)
    fp.save(tmp_path / "a.ply", model._replace(thresholds=None))
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


@pytest.mark.parametrize(
    ("name", "rows", "error"), [("a.png", 60, OutputError), ("a.ply", 59, AlignmentError)]
)
def test_what_cannot_be_saved_leaves_nothing(model, tmp_path, name, rows, error):
    with pytest.raises(error):
        fp.save(tmp_path / name, model._replace(thresholds=fp.ThresholdStore(rows)))
    assert list(tmp_path.iterdir()) == []
