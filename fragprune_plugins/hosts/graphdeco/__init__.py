"""Code that all descendants of the 2023 3DGS training code share.

call          the rasterizer's call in their source
adapter       the base of their adapters: seams, names, files
densifying    the rows that their densify methods copy
reading       the getters and the flags that every adapter needs
stand_ins     modules of ours for their compiled packages; imports torch
"""

from fragprune_plugins.hosts.graphdeco.adapter import (
    CLONE,
    MODEL,
    SPLIT,
    GraphdecoAdapter,
    GraphdecoDialect,
    default,
)
from fragprune_plugins.hosts.graphdeco.call import RasterizerCall
from fragprune_plugins.hosts.graphdeco.densifying import clones, needy, reaches, splits
from fragprune_plugins.hosts.kernels import SURFEL

__all__ = [
    "CLONE",
    "MODEL",
    "SPLIT",
    "SURFEL",
    "GraphdecoAdapter",
    "GraphdecoDialect",
    "RasterizerCall",
    "clones",
    "default",
    "needy",
    "reaches",
    "splits",
]
