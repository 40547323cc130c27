"""The fragment pressure that rides on the host's loss is the one written on paper."""

from dataclasses import replace

import pytest
import torch
from miniatures.vanilla_3dgs import Notes, joint, running

from fragprune_graphdeco import GraphdecoDialect
from fragprune_plugins import Fewer, Portable, Pressure, Settings
from fragprune_plugins.learning.area import area_per_pixel
from fragprune_vanilla_3dgs import Vanilla3DGS


@pytest.mark.parametrize("pressure", [0.0, 1e-4, 0.02])
def test_gradients_are_those_of_loss_plus_pressure_times_fragments(pressure):
    notes = Notes()
    with joint(
        Settings(iterations=9, goal=Pressure(pressure), train="opacity"), plugins=[notes]
    ) as host:
        model, camera = host.model(40), host.camera()
        model.update_learning_rate(1)
        store = host.store(model)
        with torch.no_grad():
            store.logits.copy_(torch.linspace(-3, 0, 40))
        image = host.render(camera, model)["render"]
        loss = (image - camera.original_image).abs().mean() * 3
        loss.backward()
        leaves = [store.logits, *(g["params"][0] for g in model.optimizer.param_groups)]
        ours = [leaf.grad.clone() for leaf in leaves]
        # The same as a function of leaves, no term added on the way.
        for leaf in leaves:
            leaf.grad = None
        image = host.render(camera, model)["render"]
        outputs = host.engine(torch.device("cpu")).rasterize(notes.inputs, store.values)
        loss = (outputs.image - camera.original_image).abs().mean() * 3
        (loss + pressure * outputs.fragments_per_pixel).backward()
        assert torch.equal(outputs.image, image)
        for leaf, grad in zip(leaves, ours, strict=True):
            torch.testing.assert_close(leaf.grad, grad, rtol=1e-5, atol=1e-9)


def test_portable_gradients_are_those_of_loss_plus_pressure_times_area():
    pressure, seen = 0.02, []
    with joint(Settings(iterations=9, goal=Portable(pressure))) as host:
        model, camera = host.model(40), host.camera()
        model.update_learning_rate(1)
        engine = host.engine(torch.device("cpu"))
        rasterize = engine.rasterize

        def noting(inputs, thresholds):
            seen.append((inputs, thresholds))
            return rasterize(inputs, thresholds)

        engine.rasterize = noting
        image = host.render(camera, model)["render"]
        ((image - camera.original_image).abs().mean() * 3).backward()
        leaves = [g["params"][0] for g in model.optimizer.param_groups]
        ours = [leaf.grad.clone() for leaf in leaves]
        for leaf in leaves:
            leaf.grad = None
        host.render(camera, model)
        (inputs, thresholds), area = seen[-1], area_per_pixel(seen[-1][0])
        assert thresholds is None
        loss = (rasterize(inputs, None).image - camera.original_image).abs().mean() * 3
        (loss + pressure * area).backward()
        assert area > 1
        for leaf, grad in zip(leaves, ours, strict=True):
            torch.testing.assert_close(leaf.grad, grad, rtol=1e-5, atol=1e-9)
        assert host.store(model).neutral


class Enlarging(GraphdecoDialect):
    """Every call draws its view three times, ever closer, and answers with their mean."""

    def answer(self, call, inputs, draw):
        views = [
            replace(inputs.view, tan_fov_x=inputs.view.tan_fov_x / n, projmatrix=zoom(inputs, n))
            for n in (1, 2, 4)
        ]
        drawn = [draw(replace(inputs, view=view), part) for part, view in enumerate(views)]
        picture = torch.stack([each.image for each in drawn]).mean(dim=0)
        return self.pack(replace(drawn[0], image=picture), call)


def zoom(inputs, times):
    return inputs.view.projmatrix @ torch.diag(torch.tensor([float(times), 1.0, 1.0, 1.0]))


class EnlargingHost(Vanilla3DGS):
    def dialect(self, repo):
        return Enlarging(**vars(super().dialect(repo)))


@pytest.mark.parametrize("adapter", [Vanilla3DGS(), EnlargingHost()], ids=["one", "three"])
def test_a_target_is_met_over_all_pictures_of_all_views(adapter):
    settings = Settings(
        iterations=12, goal=Fewer(1.6), threshold_lr=0.3, opacity_lr=1e-6, train="opacity"
    )
    with running(settings, adapter=adapter) as host:
        model, cameras = host.model(40), [host.camera(), host.camera(side=0.5)]
        for iteration in range(1, 13):
            host.step(model, cameras[iteration % 2], iteration)
        counts = []
        engine = host.engine(torch.device("cpu"))
        rasterize, store = engine.rasterize, host.store(model)

        def counting(inputs, thresholds):
            plain = rasterize(replace(inputs, stop=None), None)
            pair = plain, rasterize(inputs, store.values)
            counts.append(torch.stack([each.fragments_per_pixel for each in pair]).detach())
            return rasterize(inputs, thresholds)

        engine.rasterize = counting
        with torch.no_grad():
            for camera in cameras:
                host.render(camera, model)
        summary = host.finish()
    before, after = torch.stack(counts).sum(dim=0).tolist()
    assert before / after == pytest.approx(1.6, rel=0.015)  # a calibration ends within 0.01
    assert summary.target_reached


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
