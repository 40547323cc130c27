"""fragprune export."""

from dataclasses import replace

import pytest
import torch
from cli.commands import fails, run, run_json
from finetune import tiny

import fragprune_plugins as fp
from fragprune_plugins.files.ply import read_ply
from fragprune_plugins.workbench.models import model as models
from fragprune_plugins.workbench.models.formats.ply import write_ply


def test_one_file_with_the_thresholds(tmp_path):
    data, path, _ = tiny.scene(tmp_path)
    tuned, out = tmp_path / "tuned.ply", tmp_path / "exported.ply"
    run_json("finetune", path, "--data", data, "--out", tuned, "--iters", 10)
    report = run_json("export", tuned, "--out", out)
    assert report["column"] == "trunc_threshold"
    exported = read_ply(out)
    assert torch.equal(exported.falloff, read_ply(tuned).falloff)
    assert torch.equal(exported.opacity, read_ply(tuned).opacity)
    both = run_json("compare", tuned, out, "--data", data)
    assert both["speedup"] == 1
    assert both["psnr_change"] == 0


def test_drops_what_no_view_can_draw(tmp_path):
    _, path, model = tiny.scene(tmp_path)
    opacity = model.opacity.clone()
    opacity[5:9] = -6  # under 1/255
    thresholds = torch.linspace(0.1, 0.9, len(model))
    write_ply(path, tiny.cut(replace(model, opacity=opacity), thresholds))
    out = tmp_path / "out.ply"
    assert run_json("export", path, "--out", out)["dropped"] is None
    report = run_json("export", path, "--out", out, "--keep", "visible")
    assert report["gaussians"] == len(model) - 4
    assert report["dropped"] == {"gaussians": 4, "of": 60}
    assert out.stat().st_size < path.stat().st_size
    kept = torch.ones(len(model), dtype=torch.bool)
    kept[5:9] = False
    exported = read_ply(out)
    assert torch.equal(exported.falloff, thresholds[kept])
    assert torch.equal(exported.xyz, model.xyz[kept])
    text = run("export", path, "--out", out, "--keep", "visible").stdout
    assert "Dropped 4 of 60 Gaussians, too faint for any view." in text


def test_any_model_may_get_a_stop(tmp_path):
    model, out = tmp_path / "model.ply", tmp_path / "stopped.ply"
    write_ply(model, tiny.random_model())
    data = run_json("export", model, "--out", out, "--stop", 0.3)
    assert (data["thresholds"], data["stop"], data["column"]) == (False, 0.3, None)
    stopped, view = fp.load(out), tiny.cameras()[0].view()
    drawn, whole = (fp.rasterize(each, view) for each in (stopped, fp.load(model)))
    assert stopped.stop == 0.3
    assert drawn.fragments_per_pixel < whole.fragments_per_pixel
    assert run("export", out, "--out", tmp_path / "model.splat").exit_code != 0


@pytest.mark.parametrize("name", ["out.ply", "out.spz", "out.splat"])
def test_a_model_without_thresholds_is_written_as_it_is(tmp_path, name):
    _, path, _ = tiny.scene(tmp_path)
    result = run("export", path, "--out", tmp_path / name)
    assert result.exit_code == 0
    assert "no cutoffs" in result.stdout
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


def test_cutoffs_return_to_the_gaussians_that_an_editor_left(tmp_path, pruned):
    rows, out = torch.tensor([41, 7, 59, 0, 23]), tmp_path / "out.ply"
    write_ply(tmp_path / "edited.ply", edited(pruned, rows))
    words = (tmp_path / "pruned.ply", "--out", out)
    report = run_json("export", tmp_path / "edited.ply", *words)
    assert (report["gaussians"], report["thresholds"], report["stop"]) == (5, True, 0.02)
    assert torch.equal(read_ply(out).falloff, pruned.falloff[rows])
    assert torch.equal(read_ply(out).xyz, pruned.xyz[rows] + 3)


def test_of_gaussians_that_look_alike_the_smallest_cutoff_returns(tmp_path, pruned):
    like = torch.arange(60)
    like[[8, 30]] = 4
    looks = {"opacity": pruned.opacity[like], "f_dc": pruned.f_dc[like]}
    write_ply(tmp_path / "pruned.ply", replace(pruned, **looks))
    write_ply(tmp_path / "edited.ply", edited(replace(pruned, **looks), [30, 31]))
    out = tmp_path / "out.ply"
    run_json("export", tmp_path / "edited.ply", tmp_path / "pruned.ply", "--out", out)
    assert torch.equal(read_ply(out).falloff, pruned.falloff[[4, 31]])


@pytest.mark.parametrize("change", ["opacity", "f_dc"])
def test_a_gaussian_without_its_like_gets_no_cutoff(tmp_path, pruned, change):
    model = edited(pruned, torch.arange(60))
    values = getattr(model, change).clone()
    values[[3, 5]] += 0.01
    write_ply(tmp_path / "edited.ply", replace(model, **{change: values}))
    out = tmp_path / "out.ply"
    words = (tmp_path / "pruned.ply", "--out", out)
    asked = ("export", tmp_path / "edited.ply", *words)
    fails(*asked, says=("[row-mismatch]", "2 of 60 Gaussians"), code=1)
    assert not out.exists()


def test_a_model_without_cutoffs_has_none_to_give(tmp_path, pruned):
    write_ply(tmp_path / "plain.ply", pruned.untruncated())
    words = (tmp_path / "plain.ply", "--out", tmp_path / "out.ply")
    asked = ("export", tmp_path / "pruned.ply", *words)
    fails(*asked, says="plain.ply: a model without cutoffs", code=1)


def test_the_model_that_gives_cutoffs_is_not_overwritten(tmp_path, pruned):
    path, before = tmp_path / "pruned.ply", (tmp_path / "pruned.ply").read_bytes()
    write_ply(tmp_path / "edited.ply", edited(pruned, torch.arange(9)))
    fails("export", tmp_path / "edited.ply", path, "--out", path, says="the model's name")
    assert path.read_bytes() == before
