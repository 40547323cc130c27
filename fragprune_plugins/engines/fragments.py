"""The fragments themselves, as the oracle draws them: for audits, and no host needs them."""

from __future__ import annotations

import math
from collections.abc import Iterator

from torch import Tensor

from fragprune_plugins.constants import TILE
from fragprune_plugins.engines.reference import camera_of, gaussians_of, options_of
from fragprune_plugins.types import RasterInputs, Splats
from reference_renderer import Blended, blended


def fragments(
    inputs: RasterInputs, thresholds: Tensor | None, tiles: int | None = None
) -> Iterator[Blended]:
    """The fragments themselves, tile by tile, for what no engine sums up. Slow.

    Args:
        inputs: Gaussians in the world.
        tiles: how many tiles are looked at, at most, evenly spread; None for all.
    """
    assert isinstance(inputs.splats, Splats)
    inputs.check_thresholds(thresholds)
    view = inputs.view
    across, down = -(-view.width // TILE), -(-view.height // TILE)
    every = 1 if tiles is None else -(-across * down // tiles)
    while math.gcd(every, across) > 1:  # else the same columns of every row
        every += 1
    drawn = camera_of(inputs), gaussians_of(inputs.splats), thresholds
    return blended(*drawn, options=options_of(inputs), every=every)
