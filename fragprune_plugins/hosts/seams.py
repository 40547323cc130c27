"""Seams: the places of a host where we wrap, as data.

A table can be printed, checked against source without importing it, tested in every order and
undone; a procedure cannot.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass, replace
from enum import Enum
from typing import Any


class Role(Enum):
    """What the session does at a seam. A closed set; the session owns each one's meaning."""

    SCENE = "learn where the host writes its output"
    ATTACH = "give the model its threshold store"
    STEP = "count one training step"
    VIEW = "remember which model is being rendered"
    RASTERIZE = "draw with thresholds"
    LOSS = "note the host's loss when it goes backward"
    METRIC = "evaluate a picture; NaN where the weights it downloads are not to be had"
    PARENTS = "work out the parents of the rows about to be appended"
    KEEP = "keep the surviving rows"
    APPEND = "append rows"
    CHOICE = "note the rows the host has drawn as parents of what it appends or overwrites next"
    COPY = "overwrite rows with copies of others; stands still in stage 2"
    REARRANGE = "keep, copy and append rows in one call; stands still in stage 2"
    FORGET = "drop the moments of rows"
    STILL = "stand still in stage 2: what would change frozen parameters or rows"
    SAVE = "write the sidecar beside the model's file"
    LOAD = "read the sidecar beside the model's file"
    PACK = "write the sidecar of a file that holds the model's Gaussians in an order of its own"
    UNPACK = "read that sidecar for the model that will be made of the file"
    CAPTURE = "put thresholds into the host's checkpoint"
    RESTORE = "take thresholds out of the host's checkpoint"


@dataclass(frozen=True)
class Seam:
    """One (module, attribute) of a host.

    Attributes:
        role: what the session does there.
        module: dotted import name.
        attribute: dotted path inside it, such as "GaussianModel.training_setup".
        needs: parameter names the function must have; the session reads its arguments by them.
        external: the module is not part of the host's folder (a compiled package), so only the
            import can check it.
    """

    role: Role
    module: str
    attribute: str
    needs: tuple[str, ...] = ()
    external: bool = False

    def __str__(self) -> str:
        return f"{self.module}:{self.attribute}"


def revised(
    seams: Iterable[Seam], changes: Mapping[str, Mapping[str, Any] | None]
) -> tuple[Seam, ...]:
    """A table of seams as a descendant has it.

    Args:
        seams: the ancestor's.
        changes: other fields of a seam, by its attribute; None leaves it out.

    Raises:
        ValueError: a seam that is changed is not there.
    """
    table = tuple(seams)
    if missing := changes.keys() - {seam.attribute for seam in table}:
        raise ValueError(f"no seam at {', '.join(sorted(missing))}")
    fields = ((seam, changes.get(seam.attribute, {})) for seam in table)
    return tuple(replace(seam, **new) for seam, new in fields if new is not None)
