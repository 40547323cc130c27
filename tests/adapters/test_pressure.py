"""The fragment pressure that rides on the host's loss is the one written on paper."""

from types import SimpleNamespace

import pytest
import torch
from miniatures.vanilla_3dgs import joint, running

from fragprune_plugins import Fewer, Portable, Pressure, Settings
from fragprune_plugins.learning.area import area_per_pixel


@pytest.mark.parametrize("goal", [Pressure(0.0), Pressure(1e-4), Pressure(0.02), Portable(0.02)])
def test_gradients_are_those_of_loss_plus_pressure_times_what_is_pressed(goal):
    """Fragments, for a portable model area: as a function of leaves, no term added on the way."""
    portable, drawn = isinstance(goal, Portable), []
    with joint(Settings(iterations=9, goal=goal, train="all" if portable else "opacity")) as host:
        model, camera = host.model(40), host.camera()
        model.update_learning_rate(1)
        store, engine = host.store(model), host.engine(torch.device("cpu"))
        if not portable:
            with torch.no_grad():
                store.logits.copy_(torch.linspace(-3, 0, 40))
        rasterize = engine.rasterize

        def noting(inputs, thresholds):
            drawn.append((inputs, thresholds))
            return rasterize(inputs, thresholds)

        engine.rasterize = noting
        leaves = [g["params"][0] for g in model.optimizer.param_groups]
        leaves += [] if portable else [store.logits]

        def gradients(loss):
            for leaf in leaves:
                leaf.grad = None
            loss.backward()
            return [leaf.grad.clone() for leaf in leaves]

        image = host.render(camera, model)["render"]
        ours = gradients((image - camera.original_image).abs().mean() * 3)
        host.render(camera, model)
        inputs, thresholds = drawn[-1]
        assert (thresholds is None) == portable
        outputs = rasterize(inputs, None if portable else store.values)
        assert torch.equal(outputs.image, image)
        pressed = area_per_pixel(inputs) if portable else outputs.fragments_per_pixel
        loss = (outputs.image - camera.original_image).abs().mean() * 3
        for found, expected in zip(ours, gradients(loss + goal.weight * pressed), strict=True):
            torch.testing.assert_close(found, expected, rtol=1e-5, atol=1e-9)
        assert pressed > 1
        assert store.neutral == portable


def test_what_a_viewer_draws_between_two_steps_is_not_learned_from():
    """3DGS draws for a viewer that is connected with gradients, before the next step begins."""
    learned = []
    for shown in (0, 3):
        with running(Settings(iterations=9, goal=Fewer(1.2), train="opacity")) as host:
            model, cameras = host.model(40), [host.camera(), host.camera(side=0.3)]
            for iteration in range(1, 10):
                for _ in range(shown):
                    host.render(host.camera(side=-0.5), model)
                host.step(model, cameras[iteration % 2], iteration)
            state = host.session.models[model]
            learned.append((state.store.logits.detach(), len(state.seen), host.finish()))
    assert torch.equal(learned[0][0], learned[1][0])
    assert learned[0][1:] == learned[1][1:]


def test_a_host_that_steps_several_times_between_two_beginnings_learns_from_all_it_draws():
    with running(Settings(iterations=9, goal=Pressure(1e-3), train="opacity")) as host:
        model, camera, other = host.model(40), host.camera(), host.camera(side=0.3)
        state = host.session.models[model]
        for iteration in range(1, 4):
            host.step(model, camera, iteration)
            image = host.render(other, model)["render"]
            (image - other.original_image).abs().mean().backward()
            model.optimizer.step()
            assert state.stage._views.drawn == (1 if iteration == 1 else 2)


def test_cameras_made_anew_for_each_step_are_one_view_by_number_name_and_size():
    with running(Settings(iterations=9, goal=Pressure(1e-3), train="opacity")) as host:
        model = host.model(40)
        for iteration in range(1, 10):
            host.step(model, host.camera(side=0.3 * (iteration % 2)), iteration)
        assert len(host.session.models[model].stage._before) == 2
        small, alike = host.camera(12, 9), SimpleNamespace(uid=0, image_width=24)
        views = [host.adapter.view(each) for each in (host.camera(), small, alike)]
        assert len(set(views)) == 3


@pytest.mark.parametrize("goal", [Pressure(0.02), Portable(0.02)])
def test_two_losses_of_one_picture_are_pressed_upon_once_and_count_together(goal):
    """A gradient that a host only looks at in between takes no pressure away."""
    portable, felt = isinstance(goal, Portable), []
    settings = Settings(iterations=9, goal=goal, train="all" if portable else "opacity")
    for looks, apart in ((False, False), (False, True), (True, False)):
        with joint(settings) as host:
            model, camera = host.model(40), host.camera()
            host.step(model, camera, 1)
            model.update_learning_rate(2)
            package = host.render(camera, model)
            first, second = package["render"].mean(), package["render"].square().mean()
            if looks:
                torch.autograd.grad(first, package["viewspace_points"], retain_graph=True)
            if apart:
                first.backward(retain_graph=True)
                second.backward()
            else:
                (first + second).backward()
            stage = host.session.models[model].stage
            grads = [*host.gradients(model).values(), stage.store.logits.grad]
            felt.append([*(g for g in grads if g is not None), torch.tensor(stage._views.loss)])
    for others in felt[1:]:
        torch.testing.assert_close(others, felt[0], rtol=1e-4, atol=1e-8)
