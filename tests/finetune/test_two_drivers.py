"""One stage 2: a host's training and ``finetune`` learn the same thresholds, to the bit.

The same Gaussians, views, order, loss and engine go through both drivers. Whatever a user asks for
or a plugin changes must act alike in both, so every case compares the whole course.
"""

import math
import random
from dataclasses import dataclass
from types import SimpleNamespace

import pytest
import torch
from miniatures.vanilla_3dgs import running

from fragprune_plugins import Control, Fewer, Pressure, Schedule, Settings, StepPlan, View, finetune
from fragprune_plugins.adapting import hookimpl, read_ply
from fragprune_plugins.workbench.finetune.losses import photometric_loss
from fragprune_plugins.workbench.scenes.dataset import Dataset, Shot

STEPS = 24


@dataclass(frozen=True, eq=False)
class Photograph(Shot):
    """What ``finetune`` takes of a photograph, made of a host's camera."""

    pixels: torch.Tensor

    @property
    def image(self):
        """The host's own picture."""
        return self.pixels


class Nearer:
    """A plugin that cuts nearer than what was learned, and lets that learn on."""

    @hookimpl
    def fragprune_truncate(self, inputs, store):
        return 0.1 + 0.8 * store.values


class Halting(Schedule):
    """Learns in turns of four steps, and slows down by halves instead of tenfold."""

    def at(self, step):
        progress = min(1.0, (step - 1) / (self.settings.iterations - 1))
        rate = 0.5**progress
        return StepPlan((step - 1) // 4 % 2 == 0, 0.1 * rate, 0.02 * rate, progress, rate)


CASES = {
    "default": Settings(iterations=STEPS, train="opacity"),
    "pressure": Settings(iterations=STEPS, goal=Pressure(2e-3), train="opacity"),
    "target": Settings(iterations=STEPS, goal=Fewer(1.5), train="opacity"),
    "dropout": Settings(iterations=STEPS, goal=Pressure(2e-3), train="opacity", dropout=0.2),
    "appearance": Settings(iterations=STEPS, train="appearance"),
    "control": Settings(iterations=STEPS, goal=Control(), train="opacity"),
    "a schedule of one's own": Settings(iterations=STEPS, goal=Pressure(1e-3), train="appearance"),
    "a plugin's thresholds": Settings(iterations=STEPS, goal=Pressure(1e-3), train="opacity"),
}


def photograph(camera, name):
    size = {"width": camera.image_width, "height": camera.image_height}
    lens = {"tan_fov_x": math.tan(camera.FoVx / 2), "tan_fov_y": math.tan(camera.FoVy / 2)}
    place = {"viewmatrix": camera.world_view_transform, "projmatrix": camera.full_proj_transform}
    view = View(**size, **lens, **place, campos=camera.camera_center, background=torch.zeros(3))
    return Photograph(name, view, camera.original_image)


def order(count, settings):
    """The views as ``finetune`` takes them."""
    stream, queue = random.Random(settings.seed), []
    for _ in range(settings.iterations):
        if not queue:
            queue = list(range(count))
            stream.shuffle(queue)
        yield queue.pop()


@pytest.mark.parametrize("case", CASES)
def test_both_drivers_learn_the_same_to_the_bit(case, tmp_path, plug):
    settings = CASES[case]
    schedule = Halting(settings) if "schedule" in case else None
    plugins = [Nearer()] if "plugin" in case else []
    with running(settings, engine="cpu", schedule=schedule, plugins=plugins) as host:
        model = host.model(60)
        model.active_sh_degree = model.max_sh_degree  # as a training has it in the end
        cameras = [host.camera(32, 24, side=side) for side in (-0.4, -0.1, 0.2, 0.5)]
        model.save_ply(str(tmp_path / "start.ply"))
        start = read_ply(tmp_path / "start.ply")
        for step, index in enumerate(order(len(cameras), settings), start=1):
            model.update_learning_rate(step)
            image = host.render(cameras[index], model)["render"]
            photometric_loss(image, cameras[index].original_image).backward()
            model.optimizer.step()
            model.optimizer.zero_grad(set_to_none=True)
        summary, store, curves = host.finish(), host.store(model), host.curves
        opacity = model._opacity.detach().clone()
        colour = model._features_dc.detach().clone()
    for plugin in plugins:
        plug(plugin)
    shots = [photograph(camera, f"{i}") for i, camera in enumerate(cameras)]
    result = finetune(start, Dataset(shots, shots), settings, schedule=schedule, engine="cpu")

    assert torch.equal(result.model.opacity.reshape(-1), opacity.reshape(-1))
    assert torch.equal(result.model.f_dc.flatten(), colour.flatten())
    learned = result.model.thresholds
    if learned is None:
        assert store.neutral
    else:
        assert torch.equal(learned.logits, store.logits)
        assert torch.equal(learned.state_dict()["exp_avg_sq"], store.state_dict()["exp_avg_sq"])
        assert learned.steps == store.steps
    assert result.progress.steps == summary.steps == settings.iterations
    if settings.goal.presses:
        assert store.steps > 0
        assert [vars(SimpleNamespace(**p)) for p in curves] == [vars(p) for p in result.curves]
        assert result.progress.fragments_before == summary.fragments_before
        assert result.progress.fragments_after == summary.fragments_after
        assert result.progress.target_reached == summary.target_reached
