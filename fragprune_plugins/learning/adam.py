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

EPSILON = 1e-15  # as the hosts have it: a larger one freezes thresholds whose gradients are tiny
_FUSES = torch.__version__ >= "2.4"  # torch has it for a CPU since then


@contextlib.contextmanager
def stepping_fused() -> Iterator[None]:
    """Inside, every optimizer steps in the fused kernel those param groups that may.

    The option is lent for one step, because hosts save the groups in their checkpoints.
    """
    lent: list[list[dict[str, Any]]] = []

    def lend(optimizer: Any, *_: Any) -> None:
        lent.append([each for each in optimizer.param_groups if can_be_fused(optimizer, each)])
        for group in lent[-1]:
            group["fused"] = True

    def take_back(*_: Any) -> None:
        for group in lent.pop():
            group["fused"] = None

    before, after = steps.register_optimizer_step_pre_hook, steps.register_optimizer_step_post_hook
    with before(lend), after(take_back):
        yield


def can_be_fused(optimizer: Any, group: dict[str, Any]) -> bool:
    """Whether an optimizer may step a param group in the fused kernel.

    It may if it is torch's own plain Adam, and all that the kernel reads is contiguous float32 on
    the CPU.
    """
    if type(optimizer) is not torch.optim.Adam or not _FUSES:
        return False
    if group["fused"] is not None or group["capturable"] or group["differentiable"]:
        return False
    tensors = []
    for parameter in group["params"]:
        state = optimizer.state.get(parameter, {})
        tensors += [parameter, parameter.grad, *(state[name] for name in state)]
    return all(
        isinstance(each, Tensor)
        and each.layout is torch.strided
        and each.device.type == "cpu"
        and each.dtype == torch.float32
        and each.is_contiguous()
        for each in tensors
        if each is not None
    )
