"""fragprune finetune --self: no photograph, the model's own pictures instead."""

import json
import shutil
from dataclasses import replace

import pytest
import torch
from cli.commands import run_json
from finetune import tiny

import fragprune_plugins as fp
from fragprune_plugins import RasterInputs
from fragprune_plugins.learning.pressure import OWN_PRESSURE

VIEWS = [(f"view{i}", camera.view()) for i, camera in enumerate(tiny.cameras(3))]


@pytest.fixture
def cameras(tmp_path):
    """The cameras.json that a host writes."""
    path = tmp_path / "cameras.json"
    path.write_text(json.dumps(tiny.host_cameras(tiny.cameras(17))))
    return path


def finetuned(path, out, *more):
    return run_json("finetune", path, "--self", "--out", out, "--iters", 40, *more)


def test_no_photograph_is_opened(data, path, out):
    for image in data.rglob("*.png"):
        image.unlink()
    report = finetuned(path, out, "--data", data, "--pressure", 1e-3, "--keep", 0.9)
    assert (report["before"]["gaussians"], report["after"]["gaussians"]) == (60, 54)
    assert report["target"] == report["after"]["target"] == "itself"
    assert report["after"]["views"] == 2  # the folder's held-out cameras
    assert report["before"]["psnr"] is None  # infinite
    assert 25 < report["after"]["psnr"] < 80
    assert report["after"]["fragments_per_pixel"] < report["before"]["fragments_per_pixel"]
    assert fp.load(out).falloff is not None


def test_without_options_the_cameras_are_those_of_its_training(path, cameras, out, tmp_path):
    model = tmp_path / "out/point_cloud/iteration_9/point_cloud.ply"
    model.parent.mkdir(parents=True)
    shutil.copy(path, model)
    shutil.copy(cameras, tmp_path / "out/cameras.json")
    words = "Namespace(source_path='gone', white_background=True)"
    (tmp_path / "out/cfg_args").write_text(words)
    named = ("--cameras", cameras, "--white-background")
    one, two = (
        finetuned(*words, "--iters", 2, "--again")["after"]
        for words in ((model, out), (path, out, *named))
    )
    assert one["views"] == two["views"] == 3
    assert [one[key] == two[key] for key in ("psnr", "fragments_per_pixel")] == [True, True]


def test_it_has_a_pressure_of_its_own(path, cameras, out):
    words = (path, out, "--cameras", cameras, "--iters", 2)
    report = finetuned(*words)
    assert report["settings"]["itself"] is True
    assert report["pressure"] == OWN_PRESSURE
    assert finetuned(*words, "--pressure", 3e-3)["pressure"] == 3e-3


@pytest.mark.parametrize("falloff", [None, 0.4])
def test_the_target_is_what_the_model_shows_as_it_came_in(model, falloff):
    """Truncated if it was: without its thresholds a pruned model is another picture."""
    store = falloff and fp.ThresholdStore.from_falloff(torch.full((len(model),), falloff))
    shot = fp.own_pictures(replace(model, thresholds=store), VIEWS, VIEWS).train[0]
    thresholds = store and store.values.detach().clone()
    if store:
        store.place(store.logits.detach() + 1)  # it learns
    with torch.no_grad():
        expected, other = (
            fp.rasterize(RasterInputs(shot.view, model.splats()), each).image
            for each in (thresholds, None if store else torch.full((len(model),), 0.4))
        )
    assert torch.equal(shot.image, expected)
    assert not torch.equal(shot.image, other)


def test_in_python_needs_no_cameras(model):
    dataset = fp.own_pictures(model)
    assert {shot.target for shot in (*dataset.train, *dataset.test)} == {"itself"}
    assert len(dataset.test) == 12
    image = dataset.test[0].image
    assert image.shape == (3, 800, 800)
    assert float(image.max()) > 0.1
    result = fp.finetune(model, fp.own_pictures(model, VIEWS), fp.Settings(2))
    # A stop and a pressure for photographs would change what they must not.
    assert (result.settings.itself, result.model.stop) == (True, None)
