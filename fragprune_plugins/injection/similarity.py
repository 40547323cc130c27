"""On a CPU, answers a host's structural similarity in compiled code, if the host's own agrees."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import torch
from torch import Tensor

from fragprune_plugins.engines.cpu import binding
from fragprune_plugins.engines.losses import compiled_loss
from fragprune_plugins.errors import log
from fragprune_plugins.hosts.seams import Role, Seam, SeamCall
from fragprune_plugins.hosts.source import HostRepo
from fragprune_plugins.injection.state import SessionState

TOLERANCE = 1e-3  # how far apart the two may be: values, and gradients as a share of the largest


def seam_of(repo: HostRepo) -> Seam | None:
    """The function of the hosts that keep 3DGS's layout; None where there is none."""
    seam = Seam(Role.SIMILARITY, "utils.loss_utils", "ssim", ("img1", "img2"))
    parameters = repo.parameters(seam.module, seam.attribute) or ()
    return seam if parameters[:2] == seam.needs else None


def on_similarity(session: SessionState, call: SeamCall) -> Any:
    """Answer in compiled code once a call that was made both ways agreed, never if it did not."""
    pair = None if session.similar is False else images(call)
    if pair is None:
        return call.run()
    if session.similar:
        return similarity(*pair)
    theirs = call.run()
    with torch.no_grad():
        near = isinstance(theirs, Tensor) and theirs.ndim == 0
        near = near and bool(abs(theirs - similarity(*pair)) <= TOLERANCE)
    session.similar = near and agrees_on_a_probe(call.function, pair[0].shape)
    answer = "compiled code answers from now on" if session.similar else "it stays the host's"
    log.info("%s, made both ways: %s", call.seam, answer)
    return theirs


def images(call: SeamCall) -> tuple[Tensor, Tensor] | None:
    """The images of a call for compiled code, (C, H, W) or (1, C, H, W), the constant one last."""
    if len(call.args) + len(call.kwargs) != 2:  # another window, or a value for each image
        return None
    pair = [call.arguments[name] for name in call.seam.needs]
    for each in pair:
        fits = isinstance(each, Tensor) and each.dtype == torch.float32 and each.ndim in (3, 4)
        if not (fits and each.device.type == "cpu" and binding.available()):
            return None
    if pair[0].shape != pair[1].shape or (pair[0].ndim == 4 and len(pair[0]) != 1):
        return None
    pair.sort(key=lambda each: not each.requires_grad)
    return None if pair[1].requires_grad else (pair[0], pair[1])


def similarity(image: Tensor, target: Tensor) -> Tensor:
    """Mean structural similarity, by compiled code."""
    image, target = (each.reshape(each.shape[-3:]) for each in (image, target))
    return 1 - compiled_loss(image, target, ssim_weight=1.0)


@torch.enable_grad()
def agrees_on_a_probe(function: Callable[..., Any], shape: torch.Size) -> bool:
    """Whether a host's function gives the same value and gradient on two images, dark to bright."""
    stream, light = torch.Generator().manual_seed(0), torch.logspace(-2.5, 0, 40)
    image, target = (torch.rand(*shape[:-2], 24, 40, generator=stream) * light for _ in range(2))
    image.requires_grad_()
    theirs, ours = function(image, target), similarity(image, target)
    if not theirs.requires_grad:
        return False
    by_theirs, by_ours = (
        torch.autograd.grad(each, image, allow_unused=True)[0] for each in (theirs, ours)
    )
    if by_theirs is None or not abs(theirs.detach() - ours.detach()) <= TOLERANCE:
        return False
    return bool((by_theirs - by_ours).abs().max() <= TOLERANCE * by_theirs.abs().max())
