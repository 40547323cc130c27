"""Invariant 4 through the host's own call: truncation only takes away, and takes all."""

from __future__ import annotations

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from miniature import joint

from fragprune_plugins.constants import RIM_REACH, RIM_WIDTH
from fragprune_plugins.hookspecs import hookimpl

COUNT = 24


class Fixed:
    """Answers with the thresholds it holds, and asks for counts."""

    def __init__(self):
        self.tau = None
        self.counted = None

    @hookimpl
    def fragprune_truncate(self, inputs, store):
        self.counted = inputs.with_counts()
        return self.tau


def drawn(host, plugin, model, camera, tau):
    plugin.tau = tau
    host.render(camera, model)
    engine = host.engine(torch.device("cpu"))
    with torch.no_grad():
        return engine.rasterize(plugin.counted, tau)


@settings(max_examples=15)
@given(st.integers(0, 1000))
def test_a_raised_threshold_adds_no_fragment_and_drops_only_its_own(seed):
    plugin = Fixed()
    with joint(plugins=[plugin]) as host:
        model, camera = host.model(COUNT, seed=seed), host.camera()
        host.store(model).open(model.get_opacity)
        generator = torch.Generator().manual_seed(seed)
        low = 0.5 * torch.rand(COUNT, generator=generator)
        raised = torch.rand(COUNT, generator=generator) < 0.5
        high = torch.where(raised, low + 0.4 * torch.rand(COUNT, generator=generator), low)
        before = drawn(host, plugin, model, camera, low)
        after = drawn(host, plugin, model, camera, high)
    assert (after.fragments_per_gaussian <= before.fragments_per_gaussian).all()
    assert torch.equal(
        after.fragments_per_gaussian[~raised], before.fragments_per_gaussian[~raised]
    )
    assert (after.fragments <= before.fragments).all()
    assert torch.equal(after.radii, before.radii)  # hosts densify by them: thresholds leave them


def test_a_truncated_gaussian_leaves_no_trace_but_the_rims_own():
    """Row 0 is cut to nothing: image and gradients are those of a scene without it."""
    plugin = Fixed()
    with joint(plugins=[plugin]) as host:
        model, camera = host.model(COUNT), host.camera()
        host.store(model).open(model.get_opacity)
        # No pixel's falloff comes within the surrogate's reach of 1 + reach, let alone above it;
        # thresholds live below 1, so the nearest is a mean between pixels.
        tau = torch.full((COUNT,), 1e-3)
        tau[0] = 1 - 1e-6
        plugin.tau = tau.requires_grad_()
        image = host.render(camera, model)["render"]
        image.square().sum().backward()
        grads = [group["params"][0].grad.clone() for group in model.optimizer.param_groups]
        with_it = image.detach()
        assert all((g[0] == 0).all() for g in grads)
        model.prune_points(torch.arange(COUNT) == 0)
        plugin.tau = tau.detach()[1:].requires_grad_()
        image = host.render(camera, model)["render"]
        image.square().sum().backward()
        torch.testing.assert_close(image.detach(), with_it, rtol=0, atol=1e-6)
        for group, grad in zip(model.optimizer.param_groups, grads, strict=True):
            torch.testing.assert_close(group["params"][0].grad, grad[1:], rtol=1e-4, atol=1e-6)


def test_the_rims_gradient_reaches_its_own_threshold_and_nothing_else_of_the_row():
    """The threshold sits just above the brightest falloff: nothing drawn, tau alone hears of it."""
    plugin = Fixed()
    with joint(plugins=[plugin]) as host:
        model, camera = host.model(1), host.camera()
        with torch.no_grad():
            model._xyz.zero_()  # lands midway between pixels
            model._scaling.fill_(-1.0)
        host.store(model).open(model.get_opacity)
        tau = torch.tensor([0.999], requires_grad=True)
        assert 0.999 - RIM_REACH * RIM_WIDTH < 0.96
        plugin.tau = tau
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
