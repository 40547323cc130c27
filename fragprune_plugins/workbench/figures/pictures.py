"""Pictures: renders, fragment-density maps, side-by-side panels."""

from __future__ import annotations

import re
from collections.abc import Sequence
from itertools import accumulate, chain, count
from pathlib import Path
from typing import Any

import numpy as np
import PIL.Image
import PIL.ImageDraw
import PIL.ImageFont
import torch
from matplotlib import colormaps
from matplotlib.colors import to_hex
from torch import Tensor

from fragprune_plugins.engines import Engine
from fragprune_plugins.files.atomic import replacing
from fragprune_plugins.learning.stage2 import evenly_spaced
from fragprune_plugins.workbench.figures import records
from fragprune_plugins.workbench.figures.evaluate import Candidate
from fragprune_plugins.workbench.scenes.dataset import Shot

COLOURS = "inferno"
LABEL = "drawn fragments per pixel"

BESIDE = (
    *("_fragments", "_panel", "_photograph", "_original", "_pruned", "_overdraw"),
    *("_original_fragments", "_original_error", "_pruned_fragments", "_pruned_error"),
)
"""What commands add to a view's name for further pictures of it."""

_TALL, _TEXT = 240, 14  # pixels of a panel: of its pictures, at least, and of its letters
_STEM = 150  # bytes of a picture's name, of 255 that file systems allow


def stems(names: Sequence[str]) -> list[str]:
    """Names for the pictures of views, without ending: each its own, and one in a folder.

    Views of one name get numbers, such as ``r_0`` and ``r_0-2``. What is no letter, digit, space or
    one of ``._+-~()`` becomes ``_``.
    """
    taken: set[str] = set()
    found = []
    for name in names:
        plain = re.sub(r"[^\w.+~() -]", "_", name)
        stem = Path(plain).stem.lstrip(".").encode()[:_STEM].decode(errors="ignore") or "view"
        # Some file systems take upper for lower case.
        for each in chain([stem], (f"{stem}-{number}" for number in count(2))):
            files = {each.lower() + beside for beside in ("", *BESIDE)}
            if taken.isdisjoint(files):
                break
        taken |= files
        found.append(each)
    return found


def save_image(path: Path, image: Tensor) -> None:
    """Write an image (3, H, W), clamped to [0, 1], as 8-bit PNG; OutputError if it cannot be."""
    _save(path, picture(image))


def picture(image: Tensor) -> PIL.Image.Image:
    """An image (3, H, W), clamped to [0, 1], with 8 bits a channel."""
    values = 255 * image.detach().clamp(0, 1).permute(1, 2, 0).cpu().numpy()
    return PIL.Image.fromarray(np.round(values).astype(np.uint8))


def save_map(path: Path, values: Tensor, limit: float) -> None:
    """Write values (H, W), from 0 to the limit or above it, as the colours of ``colour_stops``."""
    _save(path, _map(values, limit))


def _save(path: Path, shown: PIL.Image.Image) -> None:
    with replacing(path) as temporary:
        shown.save(temporary, format="PNG")


def _map(values: Tensor, limit: float) -> PIL.Image.Image:
    levels = (255 * values.detach().float().cpu() / max(limit, 1e-9)).clamp(0, 255).round()
    shown = PIL.Image.fromarray(levels.byte().numpy(), mode="P")
    shown.putpalette(colormaps[COLOURS](range(256), bytes=True)[:, :3].tobytes())
    return shown


def colour_stops(count: int = 9) -> list[str]:
    """Colours of maps from 0 to their limit, evenly spaced, as ``#rrggbb``."""
    return [to_hex(colormaps[COLOURS](at / (count - 1))) for at in range(count)]


def save_panel(path: Path, pictures: Sequence[tuple[str, Tensor]], limit: float) -> None:
    """Write pictures of one size side by side under their titles: (3, H, W), or counts (H, W).

    Counts become colours of one scale, which ends at ``limit``.
    """
    height, width = pictures[0][1].shape[-2:]
    times = -(-_TALL // height)  # small pictures grow by whole pixels
    font = PIL.ImageFont.load_default(_TEXT)
    if any(each.ndim == 2 for _, each in pictures):
        scale = torch.linspace(limit, 0, height)[:, None].expand(-1, max(1, width // 12))
        pictures = [*pictures, (f"{LABEL}, 0 to {limit:g}", scale)]
    images = (picture(p) if p.ndim == 3 else _map(p, limit).convert("RGB") for _, p in pictures)
    shown = list(zip((title for title, _ in pictures), images, strict=True))
    wide = [max(times * each.width, int(font.getlength(title))) + _TEXT for title, each in shown]
    panel = PIL.Image.new("RGB", (sum(wide), times * height + 2 * _TEXT), "white")
    pen = PIL.ImageDraw.Draw(panel)
    for at, (title, each) in zip(accumulate([0, *wide]), shown, strict=False):
        pen.text((at, _TEXT // 4), title, "black", font)
        large = each.resize((times * each.width, times * height), PIL.Image.Resampling.NEAREST)
        panel.paste(large, (at, 2 * _TEXT))
    _save(path, panel)


PANELS = 4


def leave_panels(
    out: Path,
    command: str,
    report: dict[str, Any],
    columns: dict[str, Candidate],
    shots: Sequence[Shot],
    engine: Engine,
) -> str:
    """Draw ``PANELS`` evenly spread views at most, and leave a command's record beside them.

    A panel has the photograph, the renders, and the fragments on one scale. Its name is added to
    the report, which is the record. Returns a line that says so.
    """
    files, chosen = [], evenly_spaced(shots, PANELS)
    for stem, shot in zip(stems([shot.name for shot in chosen]), chosen, strict=True):
        shown, heat = [(shot.target, shot.image)], []
        for name, candidate in columns.items():
            with torch.no_grad():
                output = candidate.draw(engine, shot.view, counts=True)
            assert output.fragments is not None
            shown.append((name, output.image))
            mean = float(output.fragments.float().mean())
            heat.append((f"{name}: {mean:.1f}/px", output.fragments))
        files.append(out / f"{stem}_panel.png")
        save_panel(files[-1], shown + heat, max(float(each.max()) for _, each in heat))
    report["files"] = [str(file) for file in files]
    records.leave(out / command, command, report)
    return f"Wrote {len(files)} pictures to {out}."
