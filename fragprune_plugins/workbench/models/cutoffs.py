"""The 8-bit form of thresholds, which carriers and viewers share.

A code c in 0..255 stands for the threshold ``255^(c/256 - 1)``. In Q = -2 ln tau, the square of the
drawn ellipse's radius in standard deviations, that is ``(256 - c) * STEP``: codes are even steps of
Q. Code 0 is 1/255, which cuts nothing: no opacity is above 1, so a fragment that reaches an alpha
of 1/255 has a falloff of at least 1/255. ``docs/reference/cutoff.md`` is the specification.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import numpy.typing as npt

from fragprune_plugins.errors import InputError

NEUTRAL = 0  # the code that cuts nothing
STEP = 2 * math.log(255) / 256  # Q of one code: 0.0433


def encode(thresholds: npt.ArrayLike) -> npt.NDArray[np.uint8]:
    """The nearest codes in Q of thresholds of any shape, in [0, 1]; else it is an InputError.

    Q of the result is at most half a STEP (0.0217) away, so tau is within 1.1 %. Two ends differ:
    thresholds up to 1/255 become code 0, and those above 255^(-1/512) = 0.989 code 255, 0.979.
    """
    tau = np.asarray(thresholds, dtype=np.float64)
    if not ((tau >= 0) & (tau <= 1)).all():
        raise InputError("thresholds", "values outside [0, 1]", "falloffs", "Check them.")
    with np.errstate(divide="ignore"):
        steps = -2 * np.log(tau) / STEP
    return np.clip(np.rint(256 - steps), 0, 255).astype(np.uint8)


def decode(codes: npt.NDArray[Any]) -> npt.NDArray[np.float32]:
    """The thresholds of codes uint8 of any shape, from 1/255 to 0.979, exact to float32."""
    return np.exp((np.asarray(codes, dtype=np.float64) - 256) * (STEP / 2)).astype(np.float32)
