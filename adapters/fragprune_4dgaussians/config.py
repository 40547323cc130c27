"""The host's configuration: a Python file whose values win over the command line."""

from __future__ import annotations

import runpy
from pathlib import Path
from typing import Any

from fragprune_plugins.adapting import ConfigFile

GROUPS = ("OptimizationParams", "ModelHiddenParams", "ModelParams", "PipelineParams")
"""The dicts of a file that the host reads, in its order. The last value of an argument wins."""


class PythonFile(ConfigFile):
    """A Python file that assigns dicts, and may name files in ``_base_`` that it builds on.

    It is run, as the host does: with mmcv 1, and its forks with mmengine or a reader of their own.
    """

    def read(self, path: Path) -> dict[str, Any]:
        """Values by argument name."""
        groups = _groups(path)
        return {key: value for name in GROUPS for key, value in groups.get(name, {}).items()}

    def copied(self, path: Path, values: dict[str, Any]) -> str:
        """A file that builds on the given one, and has the new values in the group that wins."""
        return f"_base_ = [{str(path.resolve())!r}]\n{GROUPS[-1]} = {values!r}\n"


def _groups(path: Path) -> dict[str, dict[str, Any]]:
    """The dicts of a file over those of the files that it builds on."""
    own = runpy.run_path(str(path))
    bases = own.get("_base_", [])
    paths = [bases] if isinstance(bases, str) else bases
    groups: dict[str, dict[str, Any]] = {}
    for each in [*(_groups(path.parent / base) for base in paths), own]:
        groups |= {name: groups.get(name, {}) | each[name] for name in GROUPS if name in each}
    return groups
