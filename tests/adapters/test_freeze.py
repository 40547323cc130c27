"""Invariant 6 where hosts do more than the kit's: other optimizers, rates, steps of their own."""

import pytest
import torch
from miniatures.vanilla_3dgs import running

from fragprune_plugins.injection.stepping import asking_for_no_gradient
from fragprune_plugins.learning.schedule import Settings


@pytest.mark.parametrize("train", ["appearance", "all"])
def test_what_an_optimizer_beside_the_models_trains_moves_only_if_everything_does(train):
    with running(Settings(iterations=9, train=train), from_step=1) as host:
        model, camera = host.model(20), host.camera()
        exposure = torch.nn.Parameter(torch.ones(3, 4))
        model.exposure_optimizer = torch.optim.Adam([exposure], lr=0.1, weight_decay=0.1)
        model.training_setup(host.arguments)
        host.step(model, camera, 1)
        model.update_learning_rate(2)
        image = host.render(camera, model)["render"] * exposure[:, :1, None]
        (image - camera.original_image).abs().mean().backward()
        model.optimizer.step()
        model.exposure_optimizer.step()
    assert torch.equal(exposure, torch.ones(3, 4)) == (train != "all")


@pytest.mark.skipif(torch.__version__ < "2.4", reason="torch fuses no Adam on a CPU")
def test_on_a_cpu_adam_is_fused_in_both_stages_and_the_host_pickles_its_own():
    with running(Settings(iterations=5, train="appearance"), from_step=2) as host:
        model, camera = host.model(20), host.camera()
        groups, fused = model.optimizer.param_groups, []
        model.optimizer.register_step_pre_hook(
            lambda *_: fused.append({g["name"] for g in groups if g["fused"]})
        )
        for iteration in (1, 2, 3, 4):
            host.step(model, camera, iteration)
            assert not any(group["fused"] for group in groups)
    assert fused == [{group["name"] for group in groups}] * 4


def test_thresholds_step_once_a_counted_step_however_often_the_hosts_optimizer_does():
    """A subclass whose step() calls its parent's fires the hook twice."""
    with running(Settings(iterations=9, train="opacity")) as host:
        model, camera = host.model(20), host.camera()
        for iteration in (1, 2, 3):
            model.update_learning_rate(iteration)
            host.render(camera, model)["render"].sum().backward()
            model.optimizer.step()
            model.optimizer.step()
        assert host.store(model).steps == 3


def test_a_host_that_fails_to_draw_keeps_its_parameters_as_they_were():
    with running(Settings(iterations=9, train="opacity")) as host:
        model = host.model(20)
        host.step(model, host.camera(), 1)
        with pytest.raises(AttributeError):
            host.render(object(), model)
        assert all(g["params"][0].requires_grad for g in model.optimizer.param_groups)


def test_what_a_host_worked_out_before_is_cut_off_from_what_stands_still_alone():
    still, moving = (torch.ones(3, requires_grad=True) for _ in range(2))
    with asking_for_no_gradient([still]) as cut:
        assert not still.requires_grad
        after = still.exp()
    assert still.requires_grad
    assert not after.requires_grad
    before, mixed, other = still.exp(), still.exp() * moving, moving.exp()
    with asking_for_no_gradient([still]) as cut:
        assert not cut(before).requires_grad
        assert torch.equal(cut(before), before)
        assert cut(mixed) is mixed
        assert cut(other) is other
        assert cut(moving) is moving
        assert cut("a word") == "a word"


def test_thresholds_that_were_learned_are_not_dropped_for_new_gaussians_without_a_word(caplog):
    with running(Settings(iterations=9, train="opacity")) as host:
        model = host.model(20)
        for told in (0, 1):
            model._xyz = torch.nn.Parameter(model._xyz.detach().clone())
            model.training_setup(host.arguments)
            assert host.store(model).neutral
            assert len([each for each in caplog.messages if "20 thresholds" in each]) == told
            host.step(model, host.camera(), 1)
