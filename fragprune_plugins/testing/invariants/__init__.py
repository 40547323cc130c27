"""The promises that every adapter keeps, each as a check of one host.

A check runs in its own process. It raises AssertionError with the difference if the promise is
broken.
"""

from __future__ import annotations

from fragprune_plugins.testing.invariants.alignment import alignment
from fragprune_plugins.testing.invariants.case import Case
from fragprune_plugins.testing.invariants.freeze import freeze
from fragprune_plugins.testing.invariants.monotone import monotone
from fragprune_plugins.testing.invariants.neutral import neutral_is_the_host
from fragprune_plugins.testing.invariants.off import nothing_stays, off_is_off, orders
from fragprune_plugins.testing.invariants.picture import same_picture
from fragprune_plugins.testing.invariants.refuse import refuse
from fragprune_plugins.testing.invariants.round_trip import checkpoint, model_file

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
