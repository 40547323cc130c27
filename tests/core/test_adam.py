"""Which optimizers step in the fused kernel; it takes memory as it lies."""

import pytest
import torch

from fragprune_plugins.learning.adam import can_be_fused, stepping_fused

pytestmark = pytest.mark.skipif(torch.__version__ < "2.4", reason="torch fuses no Adam on a CPU")


def group_of(kind=torch.optim.Adam, grad=None, **options):
    parameter = torch.ones(4, 3, requires_grad=True)
    optimizer = kind([parameter], lr=0.1)
    parameter.grad = torch.ones(4, 3)
    optimizer.step()
    parameter.grad = torch.ones(4, 3) if grad is None else grad
    group = optimizer.param_groups[0]
    group.update(options)
    return optimizer, group


class Sparing(torch.optim.Adam):
    """Steps in a way of its own."""


@pytest.mark.parametrize(
    "case",
    [
        {"kind": Sparing},
        {"kind": torch.optim.AdamW},
        {"kind": torch.optim.SGD},
        {"fused": True},
        {"fused": False},
        {"differentiable": True},
        {"grad": torch.ones(4, 3).to_sparse()},
        {"grad": torch.ones(3, 4).T},
    ],
    ids=str,
)
def test_others_step_as_their_owner_has_it(case):
    assert not can_be_fused(*group_of(**case))


@pytest.mark.parametrize("name", ["exp_avg", "exp_avg_sq"])
@pytest.mark.parametrize("change", [torch.Tensor.double, lambda t: t.T.contiguous().T])
def test_moments_that_lie_otherwise_are_left_to_the_loop(name, change):
    optimizer, group = group_of()
    state = optimizer.state[group["params"][0]]
    state[name] = change(state[name])
    assert not can_be_fused(optimizer, group)


def test_inside_every_plain_adam_is_fused_for_its_step_alone():
    optimizer, group = group_of()
    other, _ = group_of(torch.optim.AdamW)
    seen = []
    for each in (optimizer, other):
        each.register_step_pre_hook(lambda each, *_: seen.append(each.param_groups[0]["fused"]))
    assert can_be_fused(optimizer, group)
    with stepping_fused():
        optimizer.step()
        other.step()
        assert group["fused"] is None
    optimizer.step()
    assert seen == [True, None, None]
