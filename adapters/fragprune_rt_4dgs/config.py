"""The host's configuration: a YAML file whose values win over the command line."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

from fragprune_plugins.adapting import ConfigFile


class YAMLFile(ConfigFile):
    """A YAML file. The host takes every value of every section, in order: the last one wins.

    The host's own reader is used, because it accepts more number formats than YAML does.
    """

    def read(self, path: Path) -> dict[str, Any]:
        """Values by argument name, sections flattened."""
        from omegaconf import OmegaConf
        from omegaconf.errors import OmegaConfBaseException
        from yaml import YAMLError

        try:
            return _flat(OmegaConf.to_container(OmegaConf.load(path), resolve=True))
        except (OmegaConfBaseException, YAMLError) as error:
            raise ValueError(str(error)) from error

    def copied(self, path: Path, values: dict[str, Any]) -> str:
        """The file's text with one more section that holds the new values."""
        lines = [f"  {name}: {json.dumps(value)}" for name, value in values.items()]
        return "\n".join([path.read_text(encoding="utf-8").rstrip(), "fragprune:", *lines, ""])


def _flat(section: Any) -> dict[str, Any]:
    if not isinstance(section, dict):
        raise ValueError("not sections of names and values")
    values: dict[str, Any] = {}
    for key, value in section.items():
        values.update(_flat(value) if isinstance(value, dict) else {key: value})
    return values
