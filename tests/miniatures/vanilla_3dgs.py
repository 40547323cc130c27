"""The demo's host in this process, under the vanilla adapter unless told otherwise."""

import signal
from typing import Any

import torch

from fragprune_plugins.plugins.hookspecs import hookimpl
from fragprune_plugins.testing import host as kit
from fragprune_plugins.testing.host import MINIATURE as HOST
from fragprune_plugins.testing.host import Running, expect_ancestors, imported, label
from fragprune_vanilla_3dgs import Vanilla3DGS

__all__ = ["HOST", "Running", "expect_ancestors", "imported", "label"]  # as the kit has them


class InterruptAt:
    """Ctrl-C, or another signal, at the end of a learned step."""

    def __init__(self, step: int, number: int = signal.SIGINT) -> None:
        self.step, self.number, self.finished = step, number, []

    @hookimpl
    def fragprune_step(self, stats: Any) -> None:
        if stats.step == self.step:
            signal.raise_signal(self.number)

    @hookimpl
    def fragprune_finished(self, summary: Any) -> None:
        self.finished.append(summary)


def running(settings=None, *, path=HOST, adapter=None, **options):
    """The host, imported under a session (activated unless told otherwise)."""
    return kit.running(settings, adapter=adapter or Vanilla3DGS(), path=path, **options)


def joint(settings=None, *, adapter=None, **options):
    """The host under a session that learns from the first step and freezes nothing."""
    return kit.joint(settings, adapter=adapter or Vanilla3DGS(), **options)


def tensors(model: Any) -> dict[str, torch.Tensor]:
    """Copies of the model's parameters by the names of its optimizer groups."""
    return kit.tensors(kit.Host(), model)
