"""fragprune export."""

import math
from dataclasses import replace

import pytest
import torch
from cli.commands import fails, run, run_json, succeeds
from finetune import tiny

import fragprune_plugins as fp
from fragprune_plugins.files.ply import read_ply
from fragprune_plugins.workbench.figures.wording import VISIBLE
from fragprune_plugins.workbench.models import model as models
from fragprune_plugins.workbench.models.formats.ply import write_ply


@pytest.mark.parametrize(
    ("suffix", "times", "far"),
    [(".spz", 1e-3, 0), (".spz", 1e4, 0), (".compressed.ply", 1, 1e4)],
    ids=["positions in too few bits", "scales cut off", "one Gaussian far away"],
)
def test_what_a_format_makes_of_the_picture_is_said(path, model, tmp_path, suffix, times, far):
    assert run_json("export", path, "--out", tmp_path / "a.ply")["psnr"] is None
    words = ("export", path, "--out", tmp_path / f"a{suffix}")
    assert run_json(*words)["psnr"] > VISIBLE
    assert "Warning" not in run(*words).stdout
    places = times * model.xyz
    places[0, 0] += far
    write_ply(path, replace(model, xyz=places, scaling=model.scaling + math.log(times)))
    assert run_json(*words)["psnr"] < VISIBLE
    assert "Warning: below 35 dB the change can be seen." in run(*words).stdout


def test_drops_what_no_view_can_draw(path, model, out):
    model.opacity[5:9] = -6  # under 1/255
    thresholds = torch.linspace(0.1, 0.9, len(model))
    write_ply(path, tiny.cut(model, thresholds))
    assert run_json("export", path, "--out", out)["dropped"] is None
    words = ("export", path, "--out", out, "--keep", "visible")
    report, before = run_json(*words), path.stat().st_size
    assert report["gaussians"] == len(model) - 4
    assert report["dropped"] == {"gaussians": 4, "of": 60}
    assert out.stat().st_size < before
    kept = torch.tensor([row for row in range(len(model)) if not 5 <= row < 9])
    exported = read_ply(out)
    assert torch.equal(exported.falloff, thresholds[kept])
    assert torch.equal(exported.xyz, model.xyz[kept])
    assert "Dropped 4 of 60 Gaussians, too faint for any view." in run(*words).stdout


def test_any_model_may_get_a_stop(path, out, tmp_path):
    data = run_json("export", path, "--out", out, "--stop", 0.3)
    assert (data["thresholds"], data["stop"], data["column"]) == (False, 0.3, None)
    stopped, view = fp.load(out), tiny.cameras()[0].view()
    drawn, whole = (fp.rasterize(each, view) for each in (stopped, fp.load(path)))
    assert stopped.stop == 0.3
    assert drawn.fragments_per_pixel < whole.fragments_per_pixel
    assert run("export", out, "--out", tmp_path / "model.splat").exit_code != 0


@pytest.mark.parametrize("name", ["out.ply", "out.spz", "out.splat"])
def test_a_model_without_thresholds_is_written_as_it_is(path, tmp_path, name):
    assert "no cutoffs" in succeeds("export", path, "--out", tmp_path / name).stdout
    assert not models.load(tmp_path / name).pruned


def edited(model, rows):
    """Rows of a model as an editor saves them: in its order, moved, without cutoffs and stop."""
    kept = {name: each[rows] for name, each in model.tensors.items()}
    return replace(model, **kept | {"xyz": kept["xyz"] + 3}, thresholds=None)


@pytest.fixture
def pruned(tmp_path):
    model = tiny.cut(tiny.random_model(), torch.linspace(0.1, 0.9, 60)).with_rules(stop=0.02)
    write_ply(tmp_path / "pruned.ply", model)
    return model


@pytest.fixture
def returning(tmp_path, pruned, out):
    """Words that give an edited model the cutoffs of the pruned one."""

    def words(model):
        write_ply(tmp_path / "edited.ply", model)
        return "export", tmp_path / "edited.ply", tmp_path / "pruned.ply", "--out", out

    return words


def test_cutoffs_return_to_the_gaussians_that_an_editor_left(returning, pruned, out):
    rows = torch.tensor([41, 7, 59, 0, 23])
    report = run_json(*returning(edited(pruned, rows)))
    assert (report["gaussians"], report["thresholds"], report["stop"]) == (5, True, 0.02)
    assert torch.equal(read_ply(out).falloff, pruned.falloff[rows])
    assert torch.equal(read_ply(out).xyz, pruned.xyz[rows] + 3)


def test_of_gaussians_that_look_alike_the_smallest_cutoff_returns(returning, pruned, out, tmp_path):
    like = torch.arange(60)
    like[[8, 30]] = 4
    alike = replace(pruned, opacity=pruned.opacity[like], f_dc=pruned.f_dc[like])
    write_ply(tmp_path / "pruned.ply", alike)
    run_json(*returning(edited(alike, [30, 31])))
    assert torch.equal(read_ply(out).falloff, pruned.falloff[[4, 31]])


@pytest.mark.parametrize("change", ["opacity", "f_dc"])
def test_a_gaussian_without_its_like_gets_no_cutoff(returning, pruned, out, change):
    model = edited(pruned, torch.arange(60))
    getattr(model, change)[[3, 5]] += 0.01
    fails(*returning(model), says=("[row-mismatch]", "2 of 60 Gaussians"), code=1)
    assert not out.exists()


def test_a_model_without_cutoffs_has_none_to_give(returning, pruned, tmp_path):
    write_ply(tmp_path / "pruned.ply", pruned.untruncated())
    fails(*returning(pruned), says="pruned.ply: a model without cutoffs", code=1)


def test_a_file_that_rounds_more_in_a_wide_scene_says_so(path, model, tmp_path):
    """24 bits hold 1/4096 of a unit up to 2,048 units; one Gaussian beyond takes a bit from all."""
    model.xyz[0] = 3000
    write_ply(path, model)
    out = tmp_path / "out.spz"
    assert "(less if one is beyond 2,048)" in run("export", path, "--out", out).stdout
    assert float((fp.load(out).xyz[1:] * 2048).frac().abs().max()) == 0
