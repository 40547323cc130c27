"""Figures of experiments: small PNGs of few colours."""

from __future__ import annotations

import io
from pathlib import Path
from typing import Any

from matplotlib.figure import Figure
from PIL import Image

_COLOURS = 255


def save_figure(path: Path, figure: Figure, dpi: int = 80) -> None:
    """Write a figure as a PNG with a palette, a third as large as one without."""
    drawn = io.BytesIO()
    figure.savefig(drawn, format="png", dpi=dpi)
    with Image.open(drawn) as picture:
        full = picture.convert("RGB")
        palette = full.quantize(_COLOURS)
        small: Any = full.quantize(palette=palette, dither=Image.Dither.FLOYDSTEINBERG)
        small.save(path, format="PNG", optimize=True)
