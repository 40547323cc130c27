"""Pictures of some views side by side: what was to be seen, renders, fragment densities."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import torch

from fragprune_plugins.engines import Engine
from fragprune_plugins.files import records
from fragprune_plugins.learning.stage2 import evenly
from fragprune_plugins.workbench.figures.evaluate import Candidate
from fragprune_plugins.workbench.figures.pictures import save_panel, stems
from fragprune_plugins.workbench.scenes.dataset import Shot

PANELS = 4


def leave_panels(
    out: Path,
    command: str,
    report: dict[str, Any],
    columns: dict[str, Candidate],
    shots: Sequence[Shot],
    engine: Engine,
) -> str:
    """Draw views into a folder, and leave a command's record there; returns a line that says so.

    The record is the report with ``files``, the names of the pictures, which is added.
    """
    files = draw_panels(out, columns, shots, engine)
    report["files"] = [str(file) for file in files]
    records.leave(out / command, command, report)
    return f"Wrote {len(files)} pictures to {out}."


def draw_panels(
    out: Path, columns: dict[str, Candidate], shots: Sequence[Shot], engine: Engine
) -> list[Path]:
    """Draw evenly spread views: photograph, renders, and fragment densities on one scale.

    Args:
        shots: the views; ``PANELS`` of them at most are drawn.

    Returns:
        The files, one for each drawn view.
    """
    files = []
    drawn = {name: candidate.model.splats() for name, candidate in columns.items()}
    chosen = evenly(shots, PANELS)
    for stem, shot in zip(stems([shot.name for shot in chosen]), chosen, strict=True):
        with torch.no_grad():
            outputs = {
                name: candidate.draw(engine, shot.view, drawn[name], counts=True)
                for name, candidate in columns.items()
            }
        heat = {
            name: output.fragments
            for name, output in outputs.items()
            if output.fragments is not None
        }
        file = out / f"{stem}_panel.png"
        save_panel(
            file,
            [
                (shot.target, shot.image),
                *((name, output.image) for name, output in outputs.items()),
                *((f"{name}: {float(c.float().mean()):.1f}/px", c) for name, c in heat.items()),
            ],
            max(float(fragments.max()) for fragments in heat.values()),
        )
        files.append(file)
    return files
