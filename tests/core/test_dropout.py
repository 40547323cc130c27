"""Gaussians that a step leaves out, so that no picture hangs on a single one."""

import pytest
import torch

from fragprune_plugins import Pressure, RasterInputs, Settings, Splats, ThresholdStore, look_at
from fragprune_plugins.learning.stage2 import OPAQUE, Stage2

COUNT, STEPS = 20_000, 10
VIEW = look_at((0, 0, -3), (0, 0, 0), width=8, height=8, fov_y=50)


def stage(dropout):
    settings = Settings(iterations=STEPS, train="opacity", goal=Pressure(1e-3), dropout=dropout)
    return Stage2(ThresholdStore(COUNT), settings, truncate=lambda inputs, store: None)


def dropped(it: Stage2, step: int, opacity: float = 0.5):
    """The inputs of a step, whole and as they are drawn."""
    while it.steps < step:
        it.begin(lambda: torch.full((COUNT,), 0.5))
    opacities = torch.full((COUNT,), opacity, requires_grad=True)
    zeros = torch.zeros(COUNT, 3)
    splats = Splats(
        zeros, opacities, scales=zeros + 0.1, rotations=torch.ones(COUNT, 4), sh=zeros[:, None]
    )
    whole = RasterInputs(VIEW, splats)
    return whole, it.dropped(whole)


@pytest.mark.parametrize(("step", "share"), [(1, 0.2), (4, 0.2 * 2 / 3), (7, 0.2 / 3)])
def test_leaves_out_a_share_that_falls_and_keeps_the_mean(step, share):
    opacities = dropped(stage(0.2), step)[1].splats.opacities.detach()
    left_out = (opacities == 0).float().mean()
    assert left_out == pytest.approx(share, abs=4 * (share / COUNT) ** 0.5)  # four deviations
    assert opacities.max() == pytest.approx(0.5 / (1 - share))
    assert opacities.mean() == pytest.approx(0.5, abs=4 * 0.5 * (share / COUNT) ** 0.5)


def test_what_is_left_out_gets_no_gradient():
    whole, part = dropped(stage(0.2), 1)
    part.splats.opacities.sum().backward()
    kept = part.splats.opacities > 0
    assert torch.equal(whole.splats.opacities.grad > 0, kept)


def test_no_opacity_exceeds_what_engines_take():
    opacities = dropped(stage(0.5), 1, opacity=0.9)[1].splats.opacities.detach()
    assert opacities.max() == pytest.approx(OPAQUE)


def test_others_in_each_step_the_same_in_a_repeated_one():
    it, again = stage(0.2), stage(0.2)
    first, second = (dropped(it, step)[1].splats.opacities == 0 for step in (1, 2))
    assert not torch.equal(first, second)
    state = torch.random.get_rng_state()
    assert torch.equal(dropped(again, 2)[1].splats.opacities == 0, second)
    assert torch.equal(torch.random.get_rng_state(), state)


@pytest.mark.parametrize(("dropout", "step"), [(None, 1), (0.0, 1), (0.2, STEPS)])
def test_without_dropout_and_in_the_last_step_pictures_are_whole(dropout, step):
    whole, part = dropped(stage(dropout), step)
    assert part is whole


def test_pictures_without_a_gradient_are_whole():
    it = stage(0.2)
    with torch.no_grad():
        whole, part = dropped(it, 1)
    assert part is whole
