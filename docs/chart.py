"""Draws the first table of docs/results.md as a chart: ``python docs/chart.py``."""

from __future__ import annotations

import re
from pathlib import Path

import matplotlib as mpl

mpl.use("Agg")
from matplotlib import pyplot as plt

RESULTS = Path(__file__).parent / "results.md"
CHART = RESULTS.with_name("gallery") / "default.png"
INKED = ("text.color", "axes.labelcolor", "axes.edgecolor", "xtick.color", "ytick.color")


def rows() -> list[tuple[str, float, float, float]]:
    """Scene and iterations, times fewer fragments, times as fast, dB against the control."""
    table = RESULTS.read_text().split("## The default")[1].split("\n\n")[2]
    found = []
    for line in table.splitlines()[2:]:
        scene, runs, _, fewer, *_, gain, frames = (each.strip() for each in line.split("|")[1:-1])
        numbers = [float(re.findall(r"[-+]?[\d.]+", each)[0]) for each in (fewer, frames, gain)]
        iterations, _, _ = runs.rpartition(", ")
        found.append((f"{scene}, {iterations} iterations", *numbers))
    return found


def draw(held: list[tuple[str, float, float, float]], ink: str, chart: Path) -> None:
    """Bars of both factors, with the decibels beside them, on no ground of their own."""
    with mpl.rc_context(dict.fromkeys(INKED, ink)):
        figure, axes = plt.subplots(figsize=(8, 0.55 * len(held) + 0.9), layout="constrained")
        for place, (_, fewer, faster, gain) in enumerate(held):
            axes.barh(place - 0.2, fewer, 0.36, color="#d0603c", label="times fewer fragments")
            axes.barh(
                place + 0.2, faster, 0.36, color="#4d86c0", label="frames of 4x, times as fast"
            )
            axes.text(max(fewer, faster) + 0.04, place, f"{gain:+.2f} dB", va="center")
        axes.set_yticks(range(len(held)), [name for name, *_ in held])
        axes.invert_yaxis()
        axes.axvline(1, linewidth=1, color="0.5")
        axes.set_xlim(0, 5.5)
        axes.set_title(
            "Beside the bars: PSNR against the same training without pruning", loc="left"
        )
        handles, labels = axes.get_legend_handles_labels()
        figure.legend(handles[:2], labels[:2], frameon=False, loc="outside lower center", ncols=2)
        axes.spines[["top", "right"]].set_visible(False)
        figure.savefig(chart, dpi=110, transparent=True)


def main() -> None:
    """For a light page and for a dark one."""
    held = rows()
    draw(held, "#222222", CHART)
    draw(held, "#dddddd", CHART.with_stem("default-dark"))


if __name__ == "__main__":
    main()
