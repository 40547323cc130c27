"""Everything that an adapter imports: ``from fragprune_plugins.adapting import ...``.

a host      HostAdapter, or ScriptAdapter where it has training scripts; HostInfo, HostRepo,
            ParamGroup, Finding
its seams   Seam, Role, SeamCall, RowTrace, revised
drawing     Dialect, HostCall; RasterInputs and its parts, RasterOutputs
its script  CommandLine, ConfigFile, Photographs
of 3DGS     GraphdecoAdapter, GraphdecoDialect, RasterizerCall: what descendants of the code of 2023
            share; ``graphdeco`` has the pieces, ``stand_ins`` modules for their compiled packages;
            read_plain tells whether a PLY is plain 3DGS, read_selection whether all rows are drawn
files       Door, for those that a host reads; Model, read_ply
settings    parse_goal
a plugin    hookimpl
errors      each with where, found, expected and remedy

Importing this module imports no torch. Model, read_ply and stand_ins load it when they
are first used: import them inside functions, or under TYPE_CHECKING; so are these two.
"""

from __future__ import annotations

from importlib import import_module
from typing import TYPE_CHECKING, Any

from fragprune_plugins.constants import ALPHA_MIN
from fragprune_plugins.errors import (
    AlignmentError,
    EngineError,
    InputError,
    Interrupted,
    ModelFileError,
    NotComparedError,
    SessionError,
    Terminated,
    UsageError,
)
from fragprune_plugins.files.reading import Door
from fragprune_plugins.hosts import graphdeco
from fragprune_plugins.hosts.adapter import (
    CommandLine,
    ConfigFile,
    Dialect,
    HostAdapter,
    HostCall,
    HostInfo,
    ParamGroup,
    ScriptAdapter,
)
from fragprune_plugins.hosts.findings import Finding
from fragprune_plugins.hosts.graphdeco import GraphdecoAdapter, GraphdecoDialect, RasterizerCall
from fragprune_plugins.hosts.photographs import Photographs
from fragprune_plugins.hosts.seams import Role, RowTrace, Seam, SeamCall, revised
from fragprune_plugins.hosts.source import HostRepo
from fragprune_plugins.learning.goals import parse_goal
from fragprune_plugins.plugins.hookspecs import hookimpl
from fragprune_plugins.types import (
    Footprints,
    RasterInputs,
    RasterOutputs,
    Splats,
    View,
)

if TYPE_CHECKING:
    from fragprune_plugins.files.model import Model
    from fragprune_plugins.files.ply import read_ply
    from fragprune_plugins.hosts.graphdeco import stand_ins
    from fragprune_plugins.hosts.plain import read_plain, read_selection

_LATE = {
    "Model": "files.model",
    "read_plain": "hosts.plain",
    "read_ply": "files.ply",
    "read_selection": "hosts.plain",
    "stand_ins": "hosts.graphdeco.stand_ins",
}

__all__ = [
    "ALPHA_MIN",
    "AlignmentError",
    "CommandLine",
    "ConfigFile",
    "Dialect",
    "Door",
    "EngineError",
    "Finding",
    "Footprints",
    "GraphdecoAdapter",
    "GraphdecoDialect",
    "HostAdapter",
    "HostCall",
    "HostInfo",
    "HostRepo",
    "InputError",
    "Interrupted",
    "Model",
    "ModelFileError",
    "NotComparedError",
    "ParamGroup",
    "Photographs",
    "RasterInputs",
    "RasterOutputs",
    "RasterizerCall",
    "Role",
    "RowTrace",
    "ScriptAdapter",
    "Seam",
    "SeamCall",
    "SessionError",
    "Splats",
    "Terminated",
    "UsageError",
    "View",
    "graphdeco",
    "hookimpl",
    "parse_goal",
    "read_plain",
    "read_ply",
    "read_selection",
    "revised",
    "stand_ins",
]


def __getattr__(name: str) -> Any:
    if name not in _LATE:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    home = import_module(f"fragprune_plugins.{_LATE[name]}")
    return getattr(home, name, home)  # a module stands for itself
