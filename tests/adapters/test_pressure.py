"""The fragment pressure that rides on the host's loss is the one written on paper."""

from dataclasses import replace

import pytest
import torch
from miniatures.vanilla_3dgs import Notes, joint, running

from fragprune_graphdeco import GraphdecoDialect
from fragprune_plugins.learning.area import area_per_pixel
from fragprune_plugins.learning.goals import Fewer, Portable, Pressure
from fragprune_plugins.learning.pressure import ELASTICITY, LEAST_PRESSURE, MOST_PRESSURE
from fragprune_plugins.learning.schedule import Settings
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


def test_a_portable_host_covers_less_and_its_thresholds_stay_neutral():
    covered = []
    for pressure in (0.0, 0.02):
        with running(Settings(iterations=30, goal=Portable(pressure))) as host:
            model, camera = host.model(40), host.camera()
            for iteration in range(1, 31):
                host.step(model, camera, iteration)
            covered.append(model.get_scaling.detach().log().mean().item())
            assert host.store(model).neutral
            assert host.finish().steps == 30
    assert covered[1] < covered[0] - 0.01


def test_evaluation_renders_feel_no_pressure_and_count_for_nothing():
    with joint(Settings(iterations=9, goal=Pressure(0.1), train="opacity")) as host:
        model, camera, other = host.model(), host.camera(), host.camera(side=0.4)
        host.step(model, camera, 1)
        before = host.finish()
        with torch.no_grad():
            host.render(other, model)
        assert host.finish() == before


def test_more_pressure_means_fewer_fragments():
    drawn = []
    for pressure in (0.0, 0.01):
        with running(
            Settings(iterations=30, goal=Pressure(pressure), threshold_lr=0.3, train="opacity")
        ) as host:
            model, camera = host.model(40), host.camera()
            for iteration in range(1, 31):
                host.step(model, camera, iteration)
            drawn.append(host.finish().fragments_after)
    assert drawn[1] < 0.8 * drawn[0]


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


def gradients(host, model, cameras, iteration):
    """Of thresholds and opacities, after one step's views; the loss is the mean over them."""
    model.update_learning_rate(iteration)
    store = host.store(model)
    with torch.no_grad():
        store.logits.copy_(torch.linspace(-3, 0, len(store)))
    leaves = [store.logits, model._opacity]
    for leaf in leaves:
        leaf.grad = None
    for camera in cameras:
        image = host.render(camera, model)["render"]
        ((image - camera.original_image).abs().mean() / len(cameras)).backward()
    return [leaf.grad.clone() for leaf in leaves]


def test_a_step_of_several_views_feels_the_mean_of_their_pressures():
    with joint(Settings(iterations=9, goal=Pressure(0.02), train="opacity")) as host:
        model = host.model(40)
        views = [host.camera(), host.camera(side=0.4), host.camera(side=-0.4)]
        alone = []
        for number, view in enumerate(views, 1):
            gradients(host, model, [view], number)  # so that the next step expects one view
            alone.append(gradients(host, model, [view], number))
        gradients(host, model, views, 7)
        together = gradients(host, model, views, 8)
        for index, grad in enumerate(together):
            expected = torch.stack([grads[index] for grads in alone]).mean(dim=0)
            torch.testing.assert_close(grad, expected, rtol=1e-5, atol=1e-9)
        host.driver.descend(model)
        host.finish()
        single, batch = host.curves[-3:-1], host.curves[-1]
        assert batch["fragments_per_pixel"] == pytest.approx(
            sum(host.curves[i]["fragments_per_pixel"] for i in (1, 3, 5)) / 3
        )
        assert batch["loss"] == pytest.approx(
            sum(host.curves[i]["loss"] for i in (1, 3, 5)) / 3, rel=1e-5
        )
        assert len(single) == 2


def test_the_default_pressure_follows_the_hosts_loss_per_fragment():
    with joint(Settings(iterations=9, train="opacity")) as host:
        model, camera = host.model(40), host.camera()
        with torch.no_grad():  # a loss small enough for a pressure between the default's ends
            camera.original_image = host.render(camera, model)["render"] + 0.06
        for iteration in range(1, 6):
            host.step(model, camera, iteration)
        host.finish()
        before, now = host.curves[:-1], host.curves[-1]
    loss = sum(step["loss"] for step in before) / len(before)
    fragments = sum(step["fragments_per_pixel"] for step in before) / len(before)
    assert len(before) == 4
    assert now["pressure"] == pytest.approx(ELASTICITY * loss / max(fragments, 1.0))
    assert LEAST_PRESSURE < now["pressure"] < MOST_PRESSURE
