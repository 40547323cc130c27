"""On a CPU, Adam steps in torch's fused kernel, whoever owns the optimizer.

It reads and writes each number once, where the plain loop makes a copy for each operation: several
times faster. Its last bits differ from the loop's.
"""

from __future__ import annotations

import contextlib
from collections.abc import Iterator
from typing import Any

import torch
from torch import Tensor
from torch.optim import optimizer as steps

EPSILON = 1e-15
"""As the hosts have it: a larger one freezes thresholds whose gradients are tiny."""


def make_adam(groups: list[dict[str, Any]]) -> torch.optim.Adam:
    """An Adam of parameters on one device; they are contiguous, as the kernel wants them."""
    devices = {each.device.type for group in groups for each in group["params"]}
    return torch.optim.Adam(groups, eps=EPSILON, fused=True if devices == {"cpu"} else None)


@contextlib.contextmanager
def stepping_fused() -> Iterator[None]:
    """Inside, every optimizer steps in the fused kernel those param groups that may.

    The option is lent for one step, because hosts save the groups in their checkpoints.
    """
    lent: list[list[tuple[dict[str, Any], Any]]] = []

    def lend(optimizer: Any, *_: Any) -> None:
        groups = [each for each in optimizer.param_groups if can_be_fused(optimizer, each)]
        lent.append([(group, group["fused"]) for group in groups])
        for group in groups:
            group["fused"] = True

    def take_back(*_: Any) -> None:
        for group, value in lent.pop():
            group["fused"] = value

    before = steps.register_optimizer_step_pre_hook(lend)
    after = steps.register_optimizer_step_post_hook(take_back)
    try:
        yield
    finally:
        before.remove()
        after.remove()


def can_be_fused(optimizer: Any, group: dict[str, Any]) -> bool:
    """Whether an optimizer may step a param group in the fused kernel.

    It may if it is torch's own plain Adam, and all that the kernel reads lies in memory as float32
    on the CPU, in one order.
    """
    if type(optimizer) is not torch.optim.Adam:
        return False
    if group["fused"] or group["capturable"] or group["differentiable"]:
        return False
    tensors = []
    for parameter in group["params"]:
        state = optimizer.state.get(parameter, {})
        tensors += [parameter, parameter.grad, *(state[name] for name in state)]
    return all(_is_plain(each) for each in tensors if each is not None)


def _is_plain(value: Any) -> bool:
    return (
        isinstance(value, Tensor)
        and value.layout is torch.strided
        and value.device.type == "cpu"
        and value.dtype == torch.float32
        and value.is_contiguous()
    )
