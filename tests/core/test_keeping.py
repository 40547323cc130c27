"""Gaussians are removed between two steps of a training, with all that has a row for each."""

import contextlib
import weakref
from types import SimpleNamespace

import pytest
import torch

from fragprune_plugins.injection.aligning import keep_rows
from fragprune_plugins.learning.thresholds import ThresholdStore

ROWS = 6
KEPT = torch.tensor([True, False, True, True, False, True])


class Plain:
    """A model as those of 3DGS hold their parameters."""

    def __init__(self, **values):
        vars(self).update(values)


def parameters():
    generator = torch.Generator().manual_seed(3)
    shapes = {"means": (ROWS, 3), "opacities": (ROWS,), "network": (4, 3)}
    return {
        name: torch.nn.Parameter(torch.rand(shape, generator=generator))
        for name, shape in shapes.items()
    }


def stepped(model, names):
    """The loss of these parameters, once it went backward; whoever has it holds its graph."""
    loss = sum((getattr(model, name) ** 3).sum() for name in names)
    loss.backward()
    return loss


@pytest.mark.parametrize("kind", [Plain, lambda **values: torch.nn.ParameterDict(values)])
def test_a_training_goes_on_as_one_that_never_had_them(kind):
    """Adam moves each row by itself: removed ones leave no trace in the others."""
    trained = []
    for removes in (True, False):
        values = parameters()
        model, statistic = kind(**values), torch.arange(float(ROWS))
        if kind is Plain:
            model.statistic, model.step = statistic, torch.tensor(7)
        else:
            model.register_buffer("statistic", statistic)
        optimizers = [torch.optim.Adam([value], lr=0.1) for value in values.values()]
        store = ThresholdStore(ROWS)
        session = SimpleNamespace(
            optimizers={model: [weakref.ref(each) for each in optimizers]},
            models={model: SimpleNamespace(store=store)},
            changing=lambda *_: contextlib.nullcontext(),
        )
        loss = None
        for step in range(4):
            if step == 2 and removes:
                keep_rows(session, model, KEPT)
                assert len(store) == int(KEPT.sum())
            loss = stepped(model, values)  # meanwhile that of before holds its own, as in hosts
            for optimizer in optimizers:
                optimizer.step()
                optimizer.zero_grad(set_to_none=True)
        assert loss.item() != 0
        trained.append({name: getattr(model, name).detach() for name in values})
        assert len(model.statistic) == (KEPT.sum() if removes else ROWS)
    assert torch.equal(trained[0]["means"], trained[1]["means"][KEPT])
    assert torch.equal(trained[0]["opacities"], trained[1]["opacities"][KEPT])
    assert torch.equal(trained[0]["network"], trained[1]["network"])
