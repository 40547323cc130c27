"""Everything that an adapter imports: ``from fragprune_plugins.adapting import ...``.

a host      HostAdapter, or ScriptAdapter where it has training scripts; HostInfo, HostRepo,
            ParamGroup and those of 3DGS (GROUPS), Finding
its source  nodes, imported, is_off, off_by_default of what HostRepo reads; Plain, change_of
its seams   Seam, Role, SeamCall, RowTrace, revised
drawing     Dialect, HostCall; RasterInputs and its parts, RasterOutputs
a proof     Prover, Proof, Place
its script  CommandLine, ConfigFile, Photographs, Resolution
files       Door, for those that a host reads; replacing, for those that we write; Model, read_ply,
            thresholds_of
settings    parse_goal
a plugin    hookimpl
errors      each with where, found, expected and remedy

Importing this module imports no torch. Model, read_ply and thresholds_of load it when they are
first used: import them inside functions, or under TYPE_CHECKING.

What descendants of the 3DGS code of 2023 share is in ``fragprune_graphdeco``.
"""

from __future__ import annotations

from importlib import import_module
from typing import TYPE_CHECKING, Any

from fragprune_plugins.constants import ALPHA_MIN, NEAR, TRANSMITTANCE_MIN
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
from fragprune_plugins.files.atomic import replacing
from fragprune_plugins.files.columns import change_of
from fragprune_plugins.files.reading import Door
from fragprune_plugins.hosts.adapter import (
    CHECKPOINT_KEY,
    GROUPS,
    CommandLine,
    ConfigFile,
    HostAdapter,
    HostInfo,
    ParamGroup,
    ScriptAdapter,
)
from fragprune_plugins.hosts.dialect import Dialect, HostCall, Place, Proof, Prover
from fragprune_plugins.hosts.findings import Finding, Plain
from fragprune_plugins.hosts.photographs import WIDEST, Photographs, Resolution
from fragprune_plugins.hosts.seams import Role, RowTrace, Seam, SeamCall, revised
from fragprune_plugins.hosts.source import (
    Function,
    HostRepo,
    imported,
    is_off,
    nodes,
    off_by_default,
)
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
    from fragprune_plugins.files.sidecar import thresholds_of

_LATE = {"Model": "model", "read_ply": "ply", "thresholds_of": "sidecar"}

__all__ = [
    "ALPHA_MIN",
    "CHECKPOINT_KEY",
    "GROUPS",
    "NEAR",
    "TRANSMITTANCE_MIN",
    "WIDEST",
    "AlignmentError",
    "CommandLine",
    "ConfigFile",
    "Dialect",
    "Door",
    "EngineError",
    "Finding",
    "Footprints",
    "Function",
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
    "Place",
    "Plain",
    "Proof",
    "Prover",
    "RasterInputs",
    "RasterOutputs",
    "Resolution",
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
    "change_of",
    "hookimpl",
    "imported",
    "is_off",
    "nodes",
    "off_by_default",
    "parse_goal",
    "read_ply",
    "replacing",
    "revised",
    "thresholds_of",
]


def __getattr__(name: str) -> Any:
    if name not in _LATE:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    return getattr(import_module(f"fragprune_plugins.files.{_LATE[name]}"), name)
