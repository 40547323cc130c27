"""Measuring splats on photographs, and the pictures of it."""

import math
from dataclasses import replace
from pathlib import Path

import pytest
import torch
from finetune import tiny
from PIL import Image

from fragprune_plugins import finetune, keep_best, keep_needed, look_at, own_pictures, render_view
from fragprune_plugins.errors import EngineError, InputError
from fragprune_plugins.plugins.hooks import engine_for
from fragprune_plugins.workbench.figures.evaluate import measure
from fragprune_plugins.workbench.figures.pictures import save_image, save_panel
from fragprune_plugins.workbench.scenes.dataset import Dataset
from fragprune_plugins.workbench.scenes.generated import views_near

NAMES = {
    *("target", "psnr", "ssim", "lpips", "fragments_per_pixel", "evaluated_per_pixel"),
    *("entries_per_pixel", "area_per_pixel", "gaussians", "frame_ms", "frame_ms_se", "engine"),
    *("device", "views"),
}


@pytest.fixture(scope="module")
def shots(dataset):
    return dataset.test


def test_report_of_the_truth(truth, shots):
    report = measure(truth, shots, repeats=2)
    assert set(report) == NAMES
    assert report["psnr"] > 50  # 8-bit photographs of itself
    assert report["ssim"] > 0.999
    assert report["lpips"] is None
    assert report["gaussians"] == 60
    assert report["views"] == 2
    assert report["frame_ms"] > 0
    assert measure(truth, shots, repeats=1)["frame_ms_se"] == 0.0
    assert report["evaluated_per_pixel"] >= report["fragments_per_pixel"] > 0


def test_one_view_of_nothing_does_not_make_pictures_equal(truth):
    near, other = tiny.cameras()[0].view(), tiny.perturbed(truth)
    away = look_at(eye=(0, 0, -5), target=(0, 0, -9), width=tiny.SIDE, height=tiny.SIDE)
    named = [("near", near), ("away", away)]

    def against_itself(model, held_out):
        return measure(model, own_pictures(truth, named, held_out), repeats=1)["psnr"]

    assert against_itself(other, named) == against_itself(other, named[:1]) < 60
    assert against_itself(other, named[1:]) == against_itself(truth, named) == math.inf


def test_nothing_to_measure_learn_or_judge_by_is_stated(truth, shots):
    for views, repeats in (([], 1), (shots, 0)):
        with pytest.raises(InputError, match="at least one of each"):
            measure(truth, views, repeats=repeats)
    with pytest.raises(InputError, match="no training view"):
        finetune(truth, Dataset([], shots))
    for keep in (lambda: keep_best(truth, 0.5, []), lambda: keep_needed(truth, [])):
        with pytest.raises(InputError, match="no view to judge by"):
            keep()


def test_what_is_no_data_set_or_settings_is_named(truth, shots):
    for given in ("path", Path("path"), None, shots[0].view, [shots[0].view]):
        for use in (measure, keep_needed):
            with pytest.raises(InputError, match="expected photographs of a data set"):
                use(truth, given)
    with pytest.raises(InputError, match="views_near: a Dataset; expected photographs"):
        views_near(Dataset(shots, shots))
    with pytest.raises(InputError, match="finetune dataset: 'path'; expected a Dataset"):
        finetune(truth, "path")
    with pytest.raises(InputError, match="finetune settings: 3; expected a Settings"):
        finetune(truth, Dataset(shots, shots), 3)
    for use in (lambda: render_view(truth, shots[0]), lambda: keep_best(truth, 0.5, shots)):
        with pytest.raises(InputError, match=r"expected a View, .* \.view of a photograph"):
            use()


@pytest.mark.parametrize(
    ("change", "said"),
    [
        (lambda image: image[:, ::2, ::2], r"\(3, 16, 16\).*\(3, 32, 32\)"),
        (lambda image: image.where(image > 0.2, torch.nan), r": NaN in [1-9]\d* of 1024 pixels"),
    ],
)
def test_an_engine_that_draws_no_picture_of_the_view_is_named(truth, shots, change, said):
    class Otherwise:
        name = "otherwise"

        def rasterize(self, inputs, thresholds):
            outputs = engine_for("reference").rasterize(inputs, thresholds)
            return replace(outputs, image=change(outputs.image))

    with pytest.raises(EngineError, match=f"engine otherwise.*{said}"):
        measure(truth, shots, engine=Otherwise())


def test_images_are_written_as_seen(tmp_path):
    image = torch.tensor([[[0.0, 2.0]], [[-1.0, 0.5]], [[1.0, 0.25]]])
    save_image(tmp_path / "deep" / "x.png", image)
    with Image.open(tmp_path / "deep" / "x.png") as picture:
        assert picture.getpixel((0, 0)) == (0, 0, 255)
        assert picture.getpixel((1, 0)) == (255, 128, 64)


def test_a_panel_shows_pictures_and_maps(tmp_path):
    counts = torch.arange(12 * 16).reshape(12, 16)
    file = tmp_path / "panel.png"
    save_panel(file, [("photo", torch.rand(3, 12, 16)), ("map", counts)], 191.0)
    with Image.open(file) as picture:
        assert min(picture.size) > 100
        assert len(picture.convert("RGB").getcolors(1 << 20)) > 20
    assert list(tmp_path.iterdir()) == [file]
