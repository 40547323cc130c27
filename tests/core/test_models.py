"""Loading and saving a model from Python."""

from dataclasses import replace

import pytest
import torch
from cli.commands import run_json
from finetune import tiny

import fragprune_plugins as fp
from fragprune_plugins.errors import AlignmentError, DivergedError, ModelFileError, OutputError
from fragprune_plugins.files import sidecar
from fragprune_plugins.workbench.models import formats
from fragprune_plugins.workbench.models.formats.ply import write_ply


@pytest.fixture
def model():
    return tiny.cut(tiny.random_model(), torch.linspace(0.01, 0.5, 60))


def test_learned_thresholds_come_back_to_the_bit(model, tmp_path):
    model.thresholds.logits.grad = torch.linspace(-1, 1, 60)
    model.thresholds.step()
    fp.save(tmp_path / "a.ply", model)
    fp.save(tmp_path / "b.ply", fp.load(tmp_path / "a.ply"))
    assert torch.equal(fp.load(tmp_path / "b.ply").falloff, model.thresholds.values.detach())
    assert (tmp_path / "a.ply").read_bytes() == (tmp_path / "b.ply").read_bytes()


def test_a_pair_is_read_and_replaced_by_one_file(model, tmp_path):
    path = tmp_path / "a.ply"
    write_ply(path, model.untruncated())
    sidecar.save(path, model.thresholds)
    read = fp.load(path)
    assert torch.equal(read.thresholds.logits, model.thresholds.logits)
    fp.save(path, read)
    assert [each.name for each in tmp_path.iterdir()] == ["a.ply"]
    assert torch.equal(fp.load(path).falloff, read.falloff)


@pytest.mark.parametrize("folder", [".", "..", "/"])
def test_a_folder_is_named_as_one(folder):
    with pytest.raises(ModelFileError, match="a folder; expected"):
        fp.load(folder)


def test_the_file_is_the_one_that_the_command_line_writes(tmp_path):
    data, path, _ = tiny.scene(tmp_path)
    out, again = tmp_path / "out.ply", tmp_path / "again.ply"
    run_json("finetune", path, "--data", data, "--out", out, "--iters", 3)
    fp.save(again, fp.finetune(path, fp.load_dataset(data), fp.Settings(3)))
    assert again.read_bytes() == out.read_bytes()


@pytest.mark.parametrize("cut", [True, False])
def test_rows_are_kept_by_a_bool_mask_alone(model, cut):
    """Whole numbers of 0 and 1 would give rows 0 and 1, over and over."""
    model = model if cut else model.untruncated()
    for mask in (torch.ones(60).long(), torch.ones(60).byte(), torch.ones(5).bool()):
        with pytest.raises(AlignmentError, match=r"expected (60|a bool mask)"):
            model.keep(mask)


def test_what_cannot_be_saved_leaves_nothing(model, tmp_path):
    """A format of 8 bits would hold numbers in place of NaN."""
    with pytest.raises(OutputError):
        fp.save(tmp_path / "a.png", model)
    for suffix in formats.SUFFIXES:
        with pytest.raises(OutputError, match="0 Gaussians"):
            fp.save(tmp_path / f"a{suffix}", model.untruncated().keep(torch.zeros(60).bool()))
        with pytest.raises(DivergedError, match=r"opacity \(60 of 60 rows\)"):
            fp.save(tmp_path / f"a{suffix}", replace(model, opacity=model.opacity * torch.nan))
    with torch.no_grad():
        model.thresholds.logits[3] = torch.nan
    with pytest.raises(DivergedError):
        fp.save(tmp_path / "a.ply", model)
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize(("offset", "warned"), [(1e3, False), (4e6, True)])
def test_places_that_are_rounder_than_their_gaussians_are_warned_of(
    tmp_path, caplog, offset, warned
):
    """As one of a georeferenced scene; float32 has steps of 0.25 at 4,000 km north."""
    model = tiny.random_model()
    write_ply(tmp_path / "m.ply", replace(model, xyz=model.xyz + torch.tensor([0, offset, 0])))
    fp.load(tmp_path / "m.ply")
    assert ("far from the origin" in caplog.text) == warned


@pytest.mark.parametrize("activated", [False, True])
def test_values_that_were_saved_after_activation_are_warned_of(tmp_path, caplog, activated):
    model = tiny.random_model()
    if activated:
        model = replace(model, opacity=model.opacity.sigmoid(), scaling=model.scaling.exp())
    write_ply(tmp_path / "m.ply", model)
    fp.load(tmp_path / "m.ply")
    assert ("saved after activation" in caplog.text) == activated
