"""Figures of experiments: small PNGs of few colours, drawn without a display."""

from __future__ import annotations

import io
from pathlib import Path
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from matplotlib.figure import Figure

_COLOURS = 255


def new_figure(width: float, height: float) -> Figure:
    """An empty figure of so many inches."""
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    figure = Figure(figsize=(width, height), layout="constrained")
    FigureCanvasAgg(figure)
    return figure


def save_figure(path: Path, figure: Figure, dpi: int = 80) -> None:
    """Write a figure as a PNG with a palette, a third as large as one without."""
    from PIL import Image

    drawn = io.BytesIO()
    figure.savefig(drawn, format="png", dpi=dpi)
    with Image.open(drawn) as picture:
        full = picture.convert("RGB")
        palette = full.quantize(_COLOURS)
        small: Any = full.quantize(palette=palette, dither=Image.Dither.FLOYDSTEINBERG)
        small.save(path, format="PNG", optimize=True)
