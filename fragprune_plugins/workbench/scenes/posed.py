"""Photographs of a scene before they are read, and which of them are held out."""

from __future__ import annotations

import logging
from pathlib import Path
from typing import NamedTuple

from fragprune_plugins.workbench.scenes.lenses import Lens
from fragprune_plugins.workbench.scenes.pinhole import Camera

log = logging.getLogger("fragprune")

HOLD_OUT = 8
"""Views 0, 8, 16, ... of the sorted names are held out (hosts' llffhold)."""


class Posed(NamedTuple):
    """A photograph that a scene lists, before any of its pixels is read.

    Attributes:
        name: unique in the scene.
        camera: of the straightened photograph.
        image: the file.
        lens: what straightens it; None if it is straight.
        mask: a picture of the same aspect, black where the photograph is to be ignored.
    """

    name: str
    camera: Camera
    image: Path
    lens: Lens | None = None
    mask: Path | None = None


def split(rows: list[Posed]) -> tuple[list[Posed], list[Posed]]:
    """The training views and the held-out views of a scene that does not say which they are.

    Hosts sort by names without their suffix and folder, 3DGS since October 2024 by whole names. It
    is warned of where that holds out other views.
    """
    ordered = sorted(rows, key=lambda row: Path(row.name).stem)
    train, test = [row for i, row in enumerate(ordered) if i % HOLD_OUT], ordered[::HOLD_OUT]
    whole = sorted(row.name for row in rows)[::HOLD_OUT]
    if set(whole) != {row.name for row in test}:
        log.warning(
            "3DGS since October 2024 holds out other views of this scene: it sorts whole names. "
            "For a model of it, rename the images so that both orders agree, and train again; "
            "until then figures on held-out views include views that it was trained on"
        )
    return train, test
