"""The host's configuration: a Python file whose values win over the command line."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from fragprune_plugins.adapting import ConfigFile

GROUPS = ("OptimizationParams", "ModelHiddenParams", "ModelParams", "PipelineParams")
"""The dicts of a file that the host reads, in its order. The last value of an argument wins."""


class PythonFile(ConfigFile):
    """A Python file that assigns dicts, and may name files in ``_base_`` that it builds on.

    The host's own reader is used, which runs the file as the host does.
    """

    def read(self, path: Path) -> dict[str, Any]:
        """Values by argument name."""
        from mmcv import Config

        config = Config.fromfile(str(path))
        groups = (config[name] for name in GROUPS if name in config)
        return {key: value for group in groups for key, value in group.items()}

    def copied(self, path: Path, values: dict[str, Any]) -> str:
        """A file that builds on the given one, and has the new values in the group that wins."""
        return f"_base_ = [{str(path.resolve())!r}]\n{GROUPS[-1]} = {values!r}\n"
