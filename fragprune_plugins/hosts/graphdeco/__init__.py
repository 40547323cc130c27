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
    group_names,
    optimizers,
)
from fragprune_plugins.hosts.graphdeco.call import (
    CallInSource,
    RasterizerCall,
    drawing_functions,
    read_calls,
)
from fragprune_plugins.hosts.graphdeco.densifying import clones, needy, reaches, splits
from fragprune_plugins.hosts.graphdeco.reading import (
    defaults,
    read_flags,
    read_getters,
    training_scripts,
)
from fragprune_plugins.hosts.kernels import SURFEL, normal_sources, vendored
from fragprune_plugins.hosts.source import is_off, nodes, off_by_default

__all__ = [
    "CLONE",
    "MODEL",
    "SPLIT",
    "SURFEL",
    "CallInSource",
    "GraphdecoAdapter",
    "GraphdecoDialect",
    "RasterizerCall",
    "clones",
    "default",
    "defaults",
    "drawing_functions",
    "group_names",
    "is_off",
    "needy",
    "nodes",
    "normal_sources",
    "off_by_default",
    "optimizers",
    "reaches",
    "read_calls",
    "read_flags",
    "read_getters",
    "splits",
    "training_scripts",
    "vendored",
]
