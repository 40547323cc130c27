"""Invariant 4's exception, the rim's gradient; the rest is tests/conformance's."""

from __future__ import annotations

import pytest
import torch
from miniatures.vanilla_3dgs import joint

from fragprune_plugins.constants import RIM_REACH, RIM_WIDTH
from fragprune_plugins.testing.invariants.case import FixedThresholds


def test_the_rims_gradient_reaches_its_own_threshold_and_nothing_else_of_the_row():
    """The threshold sits just above the brightest falloff: nothing drawn, tau alone hears of it."""
    plugin = FixedThresholds()
    with joint(plugins=[plugin]) as host:
        model, camera = host.model(1), host.camera()
        with torch.no_grad():
            model._xyz.zero_()  # lands midway between pixels
            model._scaling.fill_(-1.0)
        host.store(model).open(model.get_opacity)
        tau = torch.tensor([0.999], requires_grad=True)
        assert 0.999 - RIM_REACH * RIM_WIDTH < 0.96
        plugin.values = tau
        background = torch.zeros(3)
        image = host.render(camera, model, background)["render"]
        image.sum().backward()
        if torch.count_nonzero(image) == 0:
            assert tau.grad[0] != 0
            for group in model.optimizer.param_groups:
                grad = group["params"][0].grad
                assert grad is None or not grad.any()
        else:
            pytest.fail("a pixel's falloff exceeds 0.999: choose another camera")
