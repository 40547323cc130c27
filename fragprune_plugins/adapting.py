"""Everything that an adapter imports: ``from fragprune_plugins.adapting import ...``.

a host      HostAdapter, or ScriptAdapter where it has training scripts; HostInfo, HostRepo,
            ParamGroup and those of 3DGS (GROUPS), Finding
its source  nodes, imported of what HostRepo reads; Plain, change_of
its seams   Seam, Role, SeamCall, revised
drawing     Dialect, HostCall; RasterInputs and its parts, RasterOutputs
a proof     Prover, Proof, Place
its script  CommandLine, ConfigFile, Photographs, Resolution
files       UntrustedFile, for those that a host reads; replacing, for those that we write;
            Model, read_ply, thresholds_of
numbers     copies, which rows others are copies of; rotations of quaternions
settings    parse_goal
a plugin    hookimpl
errors      each with where, found, expected and remedy

Every name here is imported as itself: that is how Python says that a module passes it on.
Importing this module imports no torch. Model, read_ply, thresholds_of, copies and rotations load it
when they are first used: import them inside functions, or under TYPE_CHECKING.

What descendants of the 3DGS code of 2023 share is in ``fragprune_graphdeco``.
"""

from __future__ import annotations

from importlib import import_module
from typing import TYPE_CHECKING, Any

from fragprune_plugins.constants import ALPHA_MIN as ALPHA_MIN
from fragprune_plugins.constants import NEAR as NEAR
from fragprune_plugins.constants import TRANSMITTANCE_MIN as TRANSMITTANCE_MIN
from fragprune_plugins.errors import AlignmentError as AlignmentError
from fragprune_plugins.errors import EngineError as EngineError
from fragprune_plugins.errors import InputError as InputError
from fragprune_plugins.errors import Interrupted as Interrupted
from fragprune_plugins.errors import ModelFileError as ModelFileError
from fragprune_plugins.errors import NotComparedError as NotComparedError
from fragprune_plugins.errors import SessionError as SessionError
from fragprune_plugins.errors import Terminated as Terminated
from fragprune_plugins.errors import UsageError as UsageError
from fragprune_plugins.files.atomic import replacing as replacing
from fragprune_plugins.files.columns import change_of as change_of
from fragprune_plugins.files.reading import UntrustedFile as UntrustedFile
from fragprune_plugins.hosts.adapter import CHECKPOINT_KEY as CHECKPOINT_KEY
from fragprune_plugins.hosts.adapter import GROUPS as GROUPS
from fragprune_plugins.hosts.adapter import CommandLine as CommandLine
from fragprune_plugins.hosts.adapter import ConfigFile as ConfigFile
from fragprune_plugins.hosts.adapter import HostAdapter as HostAdapter
from fragprune_plugins.hosts.adapter import HostInfo as HostInfo
from fragprune_plugins.hosts.adapter import ParamGroup as ParamGroup
from fragprune_plugins.hosts.adapter import ScriptAdapter as ScriptAdapter
from fragprune_plugins.hosts.dialect import Dialect as Dialect
from fragprune_plugins.hosts.dialect import HostCall as HostCall
from fragprune_plugins.hosts.dialect import Place as Place
from fragprune_plugins.hosts.dialect import Proof as Proof
from fragprune_plugins.hosts.dialect import Prover as Prover
from fragprune_plugins.hosts.findings import Finding as Finding
from fragprune_plugins.hosts.findings import Plain as Plain
from fragprune_plugins.hosts.photographs import WIDEST as WIDEST
from fragprune_plugins.hosts.photographs import Photographs as Photographs
from fragprune_plugins.hosts.photographs import Resolution as Resolution
from fragprune_plugins.hosts.seams import Role as Role
from fragprune_plugins.hosts.seams import Seam as Seam
from fragprune_plugins.hosts.seams import SeamCall as SeamCall
from fragprune_plugins.hosts.seams import revised as revised
from fragprune_plugins.hosts.source import Function as Function
from fragprune_plugins.hosts.source import HostRepo as HostRepo
from fragprune_plugins.hosts.source import imported as imported
from fragprune_plugins.hosts.source import nodes as nodes
from fragprune_plugins.learning.goals import parse_goal as parse_goal
from fragprune_plugins.plugins.hookspecs import hookimpl as hookimpl
from fragprune_plugins.types import Footprints as Footprints
from fragprune_plugins.types import RasterInputs as RasterInputs
from fragprune_plugins.types import RasterOutputs as RasterOutputs
from fragprune_plugins.types import Splats as Splats
from fragprune_plugins.types import View as View

if TYPE_CHECKING:
    from fragprune_plugins.files.model import Model as Model
    from fragprune_plugins.files.ply import read_ply as read_ply
    from fragprune_plugins.files.sidecar import thresholds_of as thresholds_of
    from fragprune_plugins.learning.area import rotations as rotations
    from fragprune_plugins.learning.thresholds import copies as copies

_LATE = {
    **{"Model": "files.model", "read_ply": "files.ply", "thresholds_of": "files.sidecar"},
    **{"copies": "learning.thresholds", "rotations": "learning.area"},
}


def __getattr__(name: str) -> Any:
    if name not in _LATE:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    return getattr(import_module(f"fragprune_plugins.{_LATE[name]}"), name)
