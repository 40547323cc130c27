"""Photographs of a scene before they are read, and which of them are held out."""

from __future__ import annotations

import logging
from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple, TypeVar

from fragprune_plugins.workbench.scenes.lenses import Lens
from fragprune_plugins.workbench.scenes.pinhole import Camera

log = logging.getLogger("fragprune")

Item = TypeVar("Item")

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


def hold_out(items: Sequence[Item]) -> tuple[list[Item], list[Item]]:
    """The items to learn from, and every 8th for measuring, from the first on."""
    return [item for index, item in enumerate(items) if index % HOLD_OUT], [*items[::HOLD_OUT]]


def split(rows: list[Posed]) -> tuple[list[Posed], list[Posed]]:
    """The training views and the held-out views of a scene that does not say which they are.

    Hosts sort by names without their suffix and folder, which they end at the first dot; 3DGS since
    October 2024 by whole names. It is warned of where that holds out other views.
    """
    train, test = hold_out(sorted(rows, key=lambda row: Path(row.name).stem))
    whole = sorted(row.name for row in rows)[::HOLD_OUT]
    if set(whole) != {row.name for row in test}:
        log.warning(
            "3DGS since October 2024 holds out other views of this scene: it sorts whole names. "
            "For a model of it, rename the images so that both orders agree, and train again; "
            "until then figures on held-out views include views that it was trained on"
        )
    _, dotted = hold_out(sorted(rows, key=lambda row: Path(row.name).name.partition(".")[0]))
    if {row.name for row in dotted} != {row.name for row in test}:
        log.warning(
            "3DGS before October 2024 and most hosts hold out other views of this scene: to them a "
            "name ends at its first dot. For a model of them, name the images without other dots, "
            "and train again; until then figures on held-out views include views that it was "
            "trained on"
        )
    return train, test
