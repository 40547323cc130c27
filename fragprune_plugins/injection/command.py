"""The host's own command: its script, its arguments, and the few flags that we read or add."""

from __future__ import annotations

import argparse
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from fragprune_plugins.errors import UsageError
from fragprune_plugins.hosts.adapter import CommandLine, ConfigFile, read_config
from fragprune_plugins.hosts.source import HostRepo


@dataclass(frozen=True)
class HostCommand:
    """A host's command, taken apart; the host parses all of its flags itself.

    Attributes:
        script: that runs.
        arguments: as typed.
        flags: those that we read, by fields of the command line.
        line: how the host spells them.
        module: of the script, where it was ``python -m module``.
    """

    script: Path
    arguments: list[str]
    flags: argparse.Namespace
    line: CommandLine
    module: str = ""

    @classmethod
    def read(
        cls, script: Path, arguments: list[str], line: CommandLine, module: str = ""
    ) -> HostCommand:
        """Read our flags.

        Raises:
            UsageError: the host would not understand one.
        """
        return cls(script, arguments, line.read(arguments), line, module)

    def of(self, script: Path, arguments: list[str]) -> HostCommand:
        """The same host's command with another script of the folder, run as this one is."""
        package = self.module.split(".")[:-1]
        module = ".".join([*package, script.stem]) if self.module else ""
        return self.read(script, arguments, self.line, module)

    @property
    def output(self) -> Path | None:
        """The folder that the host writes, where the command names it."""
        return Path(self.flags.output) if self.flags.output else None

    @property
    def iterations(self) -> int:
        """The last of the host's training."""
        return int(self.flags.iterations or self.line.default_iterations)

    def checkpoints(self, last: int) -> list[int]:
        """Iterations to write a checkpoint at: those asked for, and the last."""
        return sorted({*(self.flags.save_checkpoints or []), last})

    def saving(self, scratch: Path, last: int, **extra: Any) -> list[str]:
        """Arguments with flags appended, and the model saved at the last iteration."""
        if self.line.checkpoints_only:
            extra["save_checkpoints"] = self.checkpoints(last)
        return self.with_flags(scratch, **extra) if extra else self.arguments

    def with_flags(self, scratch: Path, **extra: Any) -> list[str]:
        """Arguments with flags appended; argparse lets the last one win.

        Args:
            scratch: folder for a copy of the host's configuration file, which wins over flags.
            extra: values by fields of the command line.
        """
        given = {self.line.spellings(name)[-1]: value for name, value in extra.items()}
        out = list(self.arguments)
        if self.line.config and self.flags.config:
            copy = scratch / self.flags.config.name
            overrule(self.line.config, self.flags.config, copy, given)
            return [*out, self.line.config.flag, str(copy)]
        for flag, value in given.items():
            values = value if isinstance(value, list) else [value]
            out += [flag, *map(str, values)]
        return out


def split(command: list[str]) -> tuple[Path, list[str], str]:
    """Script, its arguments, and the module where it is one; a leading interpreter is dropped."""
    words = list(command)
    if words and Path(words[0]).name.startswith("python"):
        words = words[1:]
    if words[:1] == ["-m"] and len(words) > 1:
        return _script_of(words[1]), words[2:], words[1]
    if not words or not words[0].endswith(".py"):
        raise UsageError(
            "command",
            repr(" ".join(command)) if command else "none",
            "-- python train.py ... (a script of the host), or -- python -m package.module ...",
            "Put the host's own training command after --.",
        )
    script = Path(words[0]).resolve()
    if not script.is_file():
        raise UsageError(
            str(script), "no such file", "the host's training script", "Check the path."
        )
    return script, words[1:], ""


def _script_of(module: str) -> Path:
    """The file that ``python -m`` runs, found without importing: here, else an installed one."""
    for repo in (HostRepo(Path.cwd()), HostRepo.installed(module.split(".")[0])):
        script = repo.path(module) if repo else None
        if script is not None and script.name == "__init__.py":
            script = repo.path(f"{module}.__main__") if repo else None
        if script is not None:
            return script
    raise UsageError(
        f"python -m {module}",
        "no such module",
        "one in this folder, or of an installed package",
        "Go to the host's folder, install the package, or check the name.",
    )


def overrule(config: ConfigFile, path: Path, copy: Path, given: dict[str, Any]) -> None:
    """Write a copy of a configuration file with other values, and see that it says so."""
    values = {flag.lstrip("-"): value for flag, value in given.items()}
    copy.write_text(config.overrule(path.read_text(encoding="utf-8"), values), encoding="utf-8")
    said = read_config(config, copy)
    if ignored := sorted(name for name in values if said.get(name) != values[name]):
        raise UsageError(
            f"{config.flag} {path}",
            f"a layout that {', '.join(ignored)} cannot be added to",
            "that of the host's own examples",
            "Write it like these.",
        )
