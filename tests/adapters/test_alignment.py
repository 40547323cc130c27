"""Invariant 3 where it is awkward; sequences of row operations are tests/conformance's.

The oracle is the host itself: each row's red coefficient is set to a number, and hosts copy colours
from parents to children bit for bit. Thresholds start as a function of that number.
"""

import torch
from miniatures.vanilla_3dgs import expect_ancestors, joint, label

COUNT = 16


def test_two_models_have_two_stores():
    with joint() as host:
        first, second = host.model(COUNT), host.model(7, seed=1)
        label(host, first)
        label(host, second)
        first.prune_points(torch.arange(COUNT) < 3)
        second.densify_and_clone(torch.ones(7, 1), 0.5, 1e9)
        expect_ancestors(host, first)
        expect_ancestors(host, second)
        assert (len(host.store(first)), len(host.store(second))) == (COUNT - 3, 14)


def test_other_rows_start_over():
    with joint() as host:
        model = host.model(COUNT)
        label(host, model)
        model._xyz = torch.nn.Parameter(model._xyz.detach().clone())  # as re-initialising does
        model.training_setup(host.arguments)
        assert host.store(model).neutral
