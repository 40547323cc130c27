"""What a frame costs on a machine: a price for each unit of work that engines count.

The predicted time of a frame is the sum of price times count. Prices are fitted to timed frames
(``bench.calibration``). A drawn fragment is also an evaluated one, so its price is what drawing
adds.
"""

from __future__ import annotations

import json
import math
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any, Final

import numpy as np
from scipy.optimize import nnls

from fragprune_plugins.errors import CostError
from fragprune_plugins.files.atomic import replacing
from fragprune_plugins.files.reading import MEBIBYTE, Door
from fragprune_plugins.types import RasterOutputs

UNITS: Final = ("frame", "pixel", "gaussian", "entry", "evaluated", "fragment")
"""What is counted: 1; pixels; all Gaussians, seen or not; (Gaussian, tile) pairs in the engine's
lists; (Gaussian, pixel) pairs that it evaluated, waste included; those that it drew."""

THRESHOLDS_CHANGE: Final = ("entry", "evaluated", "fragment")
"""The units of which truncation leaves fewer."""

_REMEDY = "Measure prices anew: fragprune bench --calibrate."
_DOOR = Door(
    CostError,
    "no prices",
    f"a price in nanoseconds, 0 or more, for each of {', '.join(UNITS)}",
    _REMEDY,
    limit=MEBIBYTE,
    missing=_REMEDY,
)

Work = dict[str, float]
"""Counts by unit."""


def work_of(outputs: RasterOutputs) -> Work:
    """Counts of one frame that was drawn."""
    height, width = outputs.image.shape[-2:]
    per_pixel = (
        outputs.entries_per_pixel,
        outputs.evaluated_per_pixel,
        float(outputs.fragments_per_pixel.detach()),
    )
    fixed = {"frame": 1.0, "pixel": float(width * height), "gaussian": float(len(outputs.radii))}
    pairs = zip(THRESHOLDS_CHANGE, per_pixel, strict=True)
    return fixed | {unit: count * width * height for unit, count in pairs}


@dataclass(frozen=True)
class Cost:
    """Prices of one engine on one machine.

    Attributes:
        prices: nanoseconds by unit, none below 0.
        error: median of |predicted / measured - 1| over frames that were left out of the fit; NaN
            where none was.
        machine: what the prices were measured on.
    """

    prices: Mapping[str, float]
    error: float = math.nan
    machine: Mapping[str, Any] = field(default_factory=dict)

    def ms(self, work: Mapping[str, float]) -> float:
        """Predicted milliseconds of a frame."""
        return sum(self.prices[unit] * work[unit] for unit in UNITS) / 1e6

    def limit(self, work: Mapping[str, float], fewer: float) -> float:
        """How many times as fast a frame becomes if thresholds leave a ``fewer``-th of its pairs.

        Args:
            work: of the frame without truncation.
            fewer: pairs before over pairs after, in lists, evaluated and drawn alike.
        """
        rest = {unit: work[unit] / (fewer if unit in THRESHOLDS_CHANGE else 1) for unit in UNITS}
        return self.ms(work) / max(self.ms(rest), 1e-12)

    def save(self, path: Path) -> Path:
        """Write the prices as JSON; returns the path.

        Raises:
            OutputError: the place cannot be written.
        """
        error = None if math.isnan(self.error) else self.error
        with replacing(path) as temporary:
            temporary.write_text(json.dumps(asdict(self) | {"error": error}, indent=1) + "\n")
        return path

    @classmethod
    def load(cls, path: Path) -> Cost:
        """Read what ``save`` wrote.

        Raises:
            CostError: the file cannot be read, or has other than a price from 0 up for each unit.
        """
        with _DOOR.reading(path) as reading:
            data = reading.json()
            prices = {unit: float(data["prices"][unit]) for unit in UNITS}
            for unit, price in prices.items():
                if not 0 <= price < math.inf:
                    raise ValueError(f"{unit} at {price:g} ns")
            error = math.nan if data["error"] is None else float(data["error"])
            return cls(prices, error, dict(data["machine"]))


def fit(works: Sequence[Mapping[str, float]], ms: Sequence[float]) -> dict[str, float]:
    """Prices by unit, none below 0, with the least sum of squared relative errors.

    Args:
        works: counts of frames.
        ms: their times, milliseconds above 0.
    """

    times = 1e6 * np.asarray(ms)
    counts = np.array([[work[unit] for unit in UNITS] for work in works]) / times[:, None]
    scale = np.maximum(np.linalg.norm(counts, axis=0), 1e-300)
    found, _ = nnls(counts / scale, np.ones(len(times)))
    return dict(zip(UNITS, map(float, found / scale), strict=True))
