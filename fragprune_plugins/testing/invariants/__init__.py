"""The promises that every adapter keeps, each as a check of one host.

A check runs in its own process. It raises AssertionError with the difference if the promise is
broken.
"""

from __future__ import annotations

from fragprune_plugins.testing.invariants.case import Case
from fragprune_plugins.testing.invariants.drawing import monotone, neutral_is_the_host, same_picture
from fragprune_plugins.testing.invariants.learning import alignment, checkpoint, freeze, model_file
from fragprune_plugins.testing.invariants.patching import nothing_stays, off_is_off, orders, refuse

__all__ = [
    "Case",
    "alignment",
    "checkpoint",
    "freeze",
    "model_file",
    "monotone",
    "neutral_is_the_host",
    "nothing_stays",
    "off_is_off",
    "orders",
    "refuse",
    "same_picture",
]
