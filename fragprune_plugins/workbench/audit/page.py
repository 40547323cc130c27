"""The page, the sentence and the text of an audit."""

from __future__ import annotations

import math
import textwrap
from collections.abc import Mapping, Sequence
from itertools import zip_longest
from pathlib import Path
from typing import Any

from fragprune_plugins.workbench.audit.audit import DARK, SHOWN, Shown
from fragprune_plugins.workbench.figures import page
from fragprune_plugins.workbench.figures.pictures import save_image, save_map, stems
from fragprune_plugins.workbench.figures.wording import fewer, frames, quoted
from fragprune_plugins.workbench.report.page import shared_limit

ALONE = (
    "No photographs are needed. On four splats, with their own cameras, it left 1.6x to 2.0x fewer "
    "fragments at 48 to 50 dB against themselves, and frames of four times the size were 1.4x to "
    "2.1x as fast."
)
"""What pruning without photographs gained; docs/how-to/without-photographs.md has the table."""

FROM_PHOTOGRAPHS = (
    "On three scenes at full size 1,000 iterations left 2.4x to 2.8x fewer fragments and six in "
    "ten Gaussians at -0.08 to +0.05 dB against the same training without pruning, and frames "
    "were 1.7x to 1.9x as fast."
)
"""What pruning with photographs gained; docs/results.md has the table."""

UNKNOWN = "What learned cutoffs would save on this model is not known before they are learned"
_TEMPLATE = Path(__file__).with_name("audit.html")
_WORDS = 28  # characters of a line of words in a terminal: two such columns and two of numbers
_KINDS = ("", "_fragments", "_overdraw")


def draw(folder: Path, shown: Sequence[Shown]) -> dict[str, Any]:
    """Write the pictures of the shown views; returns what the page says of them.

    "limit" is the count at the top of the scale of all maps.
    """
    limit = shared_limit([each for view in shown for each in (view.fragments, view.overdraw)])
    views = []
    for stem, view in zip(stems([view.name for view in shown]), shown, strict=True):
        files = [f"{stem}{kind}.png" for kind in _KINDS]
        save_image(folder / files[0], view.image)
        save_map(folder / files[1], view.fragments, limit)
        save_map(folder / files[2], view.overdraw, limit)
        height, width = view.fragments.shape
        maps = {"fragments_per_pixel": view.fragments, "overdraw": view.overdraw}
        means = {key: float(each.float().mean()) for key, each in maps.items()}
        views.append(means | {"name": view.name, "width": width, "height": height, "files": files})
    return {"limit": limit, "views": views}


def sentence(figures: Mapping[str, Any]) -> str:
    """One line to quote."""
    idle, views = figures["idle"], "view" if figures["views"] == 1 else "views"
    drawers = "Gaussian draws" if figures["gaussians"] == 1 else "Gaussians draw"
    cameras = _FROM.get(figures["cameras"]["kind"], "given {}").format(views)
    quads = figures["viewers"][0]["shaded_per_pixel"]
    return (
        f"{figures['gaussians']:,} {drawers} {figures['fragments_per_pixel']:.1f} fragments "
        f"per pixel, {figures['frame_ms']:.1f} ms a frame of {figures['frame_size']} pixels on our "
        f"{figures['engine']} engine; a "
        f"viewer of fixed √8 sigma quads shades {quads:.1f} pixels per pixel. "
        f"{idle['together']:.0%} of the fragments can be left out together, and no pixel "
        f"changes by half an 8-bit level ({figures['views']} {cameras})."
    )


def advice(figures: Mapping[str, Any]) -> tuple[str, str]:
    """The command that learns cutoffs for this model, and what it gained elsewhere."""
    model, data = quoted(figures["model"]), f"--data {quoted(figures['data'])}"
    pictures, gained = ("--self", ALONE) if figures["data"] is None else (data, FROM_PHOTOGRAPHS)
    return f"fragprune finetune {model} {pictures} --out pruned.ply", gained


def pruning(figures: Mapping[str, Any]) -> str:
    """What learned pruning saves: of this model if it is pruned, else how to find out."""
    if not figures["truncated"]:
        command, gained = advice(figures)
        return f"{UNKNOWN} by {command}. {gained}"
    with_, without = figures["cuts"][0], figures["cuts"][-1]
    fragments = fewer(without["fragments_per_pixel"], with_["fragments_per_pixel"])
    return (
        f"This model has cutoffs. With them it draws {fragments}, {frames(without, with_)}. All "
        "cuts come on top of them. A viewer that ignores them shows another picture: "
        f"{_decibels(without['psnr'])} PSNR against this one."
    )


def text(figures: Mapping[str, Any]) -> str:
    """What a terminal shows."""
    lines = [sentence(figures), "", figures["cameras"]["why"], ""]
    for title, table in zip(_TITLES, _tables(figures), strict=True):
        lines += [f"{title}:", *_folded(table), ""]
    return "\n".join([*lines, pruning(figures)])


def _folded(table: page.Table) -> list[str]:
    """The lines of a table in a terminal; long words fold."""
    lines: list[Sequence[str]] = []
    for row in (table.head, *table.rows):
        words = [textwrap.wrap(cell, _WORDS) or [cell] for cell in row[: table.words]]
        numbers = [[cell] for cell in row[table.words :]]
        lines += zip_longest(*words, *numbers, fillvalue="")
    widths = [max(map(len, column)) for column in zip(*lines, strict=True)]
    aligned = ["<"] * table.words + [">"] * (len(widths) - table.words)
    form = "  ".join(f"{{:{side}{width}}}" for side, width in zip(aligned, widths, strict=True))
    return [form.format(*line).rstrip() for line in lines]


def compose(figures: Mapping[str, Any], folder: Path) -> str:
    """The page as HTML, with its pictures, of the figures of ``audit``, inside."""
    cuts, viewers, idle = _tables(figures)
    return page.render(
        _TEMPLATE,
        title=f"What {Path(figures['model']).name} costs to draw",
        quote=sentence(figures),
        source=lambda file: page.embedded(folder / file),
        figures=figures,
        pruning=pruning(figures),
        unknown=UNKNOWN,
        advice=advice(figures),
        cuts=cuts,
        viewers=viewers,
        idle=idle,
    )


def _tables(figures: Mapping[str, Any]) -> list[page.Table]:
    """Cuts, viewers, and where idle fragments sit."""
    idle, first, cuts = figures["idle"], figures["cuts"][0]["fragments_per_pixel"], []
    for cut in figures["cuts"]:
        drawn = cut["fragments_per_pixel"]
        ratio = f"{first / drawn:.2f}x" if drawn else ""
        decibels = [_decibels(cut[key]) for key in ("psnr", "worst_psnr")]
        frame = f"{cut['frame_ms']:.2f} ± {cut['frame_ms_se']:.2f}"
        cuts.append([cut["name"], f"{drawn:.2f}", ratio, *decibels, frame])
    head = ["left out", "fragments/pixel", "fewer", "against itself", "worst view", "frame, ms"]
    said = (
        f"{figures['views']} views; frames of {min(SHOWN, figures['views'])} of them, in turns, on "
        f"the {figures['engine']} engine ({figures['device']}). PSNR is that of the mean squared "
        "error over all views."
    )
    ours, quads = figures["evaluated_per_pixel"], figures["viewers"][0]["shaded_per_pixel"]
    keys = ("viewers", "rule", "shaded_per_pixel", "against_sqrt8")
    shading = [tuple(each[key] for key in keys) for each in figures["viewers"]]
    shading.append(("fragprune", _OURS, ours, ours / max(quads, 1e-9)))
    viewers = [[name, rule, f"{some:.1f}", f"{share:.2f}"] for name, rule, some, share in shading]
    shaded = f"{_SHADED} Its frames of {figures['frame_size']} take {figures['frame_ms']:.1f} ms."
    reasons = []
    for each in (*idle["reasons"], {"name": "all", "share": 1.0, "idle": idle["together"]}):
        share, part = each["share"], each["idle"]
        of_these = f"{part / share:.0%}" if share else ""
        reasons.append([each["name"], f"{share:.1%}", f"{part:.1%}", of_these])
    return [
        page.Table(head, cuts, said),
        page.Table(["viewer", "draws", "shaded/pixel", "against √8 quads"], viewers, shaded, 2),
        page.Table(["fragments", "of all", "idle together, of all", "of these"], reasons, _REASONS),
    ]


def _decibels(value: float | None) -> str:
    return "equal" if value is None or math.isinf(value) else f"{value:.1f} dB"


_FROM = {"orbit": "generated {} from all around", "inside": "generated {} from inside"}

_TITLES = (
    "Simple cuts, the same for all Gaussians; PSNR is against the picture as it is",
    "Pixels that each viewer shades for one pixel of the picture",
    "Where fragments are; idle together: all can go, no pixel changes by half an 8-bit level",
)
"""Of ``_tables``, where no page explains them."""

_REASONS = f"""Each fragment counts where the first of these holds. Behind what is opaque: less than
{DARK:.0%} of the light is left for it."""

_OURS = "tiles by ellipse, 1/255 or cutoff; ends where opaque"

_SHADED = """Quads: their area. Tiles: the pixels of all (Gaussian, tile) pairs; tiles that are
opaque early spare some. The last row is counted by our engine, with what it spares."""
