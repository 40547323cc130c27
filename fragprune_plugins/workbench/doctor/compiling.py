"""Which kernels are compiled in advance, and what each needs of a multiprocessor."""

from __future__ import annotations

import re
from dataclasses import dataclass
from typing import Final

from fragprune_plugins.engines.cuda.frame import blend_macros, unblend_macros

_TRAINED: Final = frozenset(("means", "hook", "opacities", "scales", "rotations", "sh"))

VARIANTS: Final[tuple[tuple[str, dict[str, int]], ...]] = (
    ("scene", {}),
    ("blend", blend_macros()),
    ("blend", blend_macros(counts=True)),
    ("blend", blend_macros(stop=True)),
    *(
        ("unblend", unblend_macros(frozenset(wanted), sh_turns=True, invdepth=invdepth))
        for wanted in (_TRAINED, _TRAINED | {"thresholds"}, {"opacities", "thresholds"})
        for invdepth in (False, True)
    ),
)
"""Sources with macros that training and fine-tuning usually ask for, to be built beforehand."""


@dataclass(frozen=True)
class Resources:
    """The resources of a multiprocessor that a kernel needs.

    Attributes:
        registers: per thread.
        stack: bytes of local memory per thread, for arrays that did not fit into registers.
        spills: bytes stored to local memory and loaded again.
        shared: bytes of shared memory per block.
    """

    registers: int
    stack: int
    spills: int
    shared: int


def resources(log: str) -> dict[str, Resources]:
    """The resources of each kernel, from the report of ptxas -v."""
    found = {}
    for part in re.split(r"Compiling entry function '", log)[1:]:
        name = part.split("'", 1)[0]
        stack, stores, loads = re.findall(r"(\d+) bytes (?:stack|spill)", part)[:3]
        registers = re.search(r"Used (\d+) registers", part)
        shared = re.search(r"(\d+) bytes smem", part)
        found[name] = Resources(
            registers=int(registers.group(1)) if registers else 0,
            stack=int(stack),
            spills=int(stores) + int(loads),
            shared=int(shared.group(1)) if shared else 0,
        )
    return found
