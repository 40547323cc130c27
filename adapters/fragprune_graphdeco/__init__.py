"""graphdeco-inria/gaussian-splatting: what adapters of this code of 2023 and its descendants share.

adapter       the base of their adapters: seams, names, files
call          the rasterizer's call in their source
densifying    the rows that their densify methods copy
reading       the getters and the flags that every adapter needs
kernels       the rule in the CUDA sources of a vendored rasterizer
plain         whether the PLY that a codebase saves is plain 3DGS
proof         proves their rasterizers: it draws by both, and ``likeness`` compares
stand_ins     modules of ours for their compiled packages

Importing this package imports no torch; ``proof``, ``likeness`` and ``stand_ins`` do.
"""

from __future__ import annotations

from collections.abc import Sequence

from fragprune_graphdeco.adapter import (
    CLONE,
    MODEL,
    SPLIT,
    GraphdecoAdapter,
    GraphdecoDialect,
    default,
    group_names,
    model_seam,
    no_noise,
    optimizers,
    rasterizer_seam,
)
from fragprune_graphdeco.call import CallInSource, RasterizerCall, drawing_functions, read_calls
from fragprune_graphdeco.densifying import clones, needy, reaches, splits
from fragprune_graphdeco.kernels import SURFEL
from fragprune_graphdeco.plain import read_models
from fragprune_graphdeco.reading import assigned, every
from fragprune_plugins.adapting import HostRepo, Plain, hookimpl

__all__ = [
    "CLONE",
    "MODEL",
    "SPLIT",
    "SURFEL",
    "CallInSource",
    "GraphdecoAdapter",
    "GraphdecoDialect",
    "RasterizerCall",
    "assigned",
    "clones",
    "default",
    "drawing_functions",
    "every",
    "group_names",
    "model_seam",
    "needy",
    "no_noise",
    "optimizers",
    "rasterizer_seam",
    "reaches",
    "read_calls",
    "splits",
]


@hookimpl
def fragprune_read_models(repo: HostRepo) -> Sequence[Plain]:
    """The models of codebases of this family."""
    return read_models(repo)
