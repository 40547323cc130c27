"""NaN and infinity end stage 2 with a stated error, and nothing of them is saved."""

import pytest
import torch
from miniatures.vanilla_3dgs import joint, running

from fragprune_plugins.errors import DivergedError
from fragprune_plugins.learning.schedule import Settings


def spoil(tensor, rows, value):
    with torch.no_grad():
        tensor[:rows] = value


@pytest.mark.parametrize("value", [torch.nan, torch.inf])
@pytest.mark.parametrize("what", ["opacity", "scaling", "thresholds", "moments"])
def test_a_host_is_not_let_save_what_is_not_finite(tmp_path, what, value):
    with running(Settings(iterations=9, train="opacity")) as host:
        model, camera = host.model(20), host.camera()
        for iteration in (1, 2, 3):
            host.step(model, camera, iteration)
        store = host.store(model)
        spoiled = {
            "opacity": model._opacity,
            "scaling": model._scaling,
            "thresholds": store.logits,
            "moments": store.adam["exp_avg"],
        }[what]
        spoil(spoiled, 3, value)
        file = tmp_path / "point_cloud.ply"
        for save in (lambda: model.save_ply(str(file)), model.capture):
            with pytest.raises(DivergedError) as caught:
                save()
            assert f"{what} (3 of 20 rows)" in caught.value.found
            assert caught.value.where == "stage 2, after step 3"
    assert not list(tmp_path.iterdir())


def test_before_stage_two_and_without_learning_the_host_saves_what_it_likes(tmp_path):
    for options in ({"from_step": 5}, {"learn": False}):
        with running(Settings(iterations=9, train="opacity"), **options) as host:
            model = host.model(20)
            host.step(model, host.camera(), 1)
            spoil(model._scaling, 1, torch.nan)
            model.save_ply(str(tmp_path / "point_cloud.ply"))
            assert model.capture()


def spoiled_step(model, camera, host, iteration):
    model.update_learning_rate(iteration)
    (host.render(camera, model)["render"].mean() * torch.nan).backward()
    model.optimizer.step()
    model.optimizer.zero_grad(set_to_none=True)


@pytest.mark.parametrize("begin", [running, joint])
def test_a_gradient_that_is_not_finite_stops_its_own_step(begin):
    with begin(Settings(iterations=9, train="opacity")) as host:
        model, camera = host.model(20), host.camera()
        host.step(model, camera, 1)
        before = model._opacity.detach().clone()
        match = rf"stage 2, step 2, view {camera.image_name}: NaN or infinity in the gradient of "
        with pytest.raises(DivergedError, match=match + r".*opacity \(20 of 20 rows\)"):
            spoiled_step(model, camera, host, 2)
        assert torch.equal(model._opacity, before)  # it was not taken


@pytest.mark.parametrize(
    ("what", "value", "noticed"),
    [("scaling", torch.nan, 10), ("scaling", torch.inf, 10), ("thresholds", torch.nan, 2)],
)
def test_what_shows_in_no_loss_is_noticed_within_ten_steps(what, value, noticed):
    """A Gaussian that is not finite is simply not drawn."""
    with running(Settings(iterations=300, train="opacity")) as host:
        model, camera = host.model(5), host.camera(8, 6)
        host.step(model, camera, 1)
        spoil(model._scaling if what == "scaling" else host.store(model).logits, 1, value)
        for iteration in range(2, noticed):
            host.step(model, camera, iteration)
        with pytest.raises(DivergedError, match=what) as caught:
            host.step(model, camera, noticed)
    assert caught.value.where == f"stage 2, after step {noticed}"
