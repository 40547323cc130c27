"""The host's own command: its script, its arguments, and the flags that fragprune reads or adds."""

from __future__ import annotations

import re
from dataclasses import dataclass
from importlib.metadata import entry_points
from pathlib import Path
from typing import Any

from fragprune_plugins.errors import UsageError, log
from fragprune_plugins.hosts.adapter import CommandLine, ConfigFile, read_config
from fragprune_plugins.hosts.source import HostRepo

_OPTION = re.compile("-[bBdEiIOPqsSuvx]+|-[WX].*")  # not -c and -m, which name what runs


@dataclass
class HostCommand:
    """The parts of a host's command. The host itself parses all of its flags.

    Attributes:
        arguments: the script's arguments, with abbreviated flags written out.
        line: the host's spellings of the flags that fragprune reads.
        module: the module's name in ``python -m module``; "" for a script.
        flags: values of these flags, by field of ``CommandLine``.

    Raises:
        UsageError: a flag lacks its value, or the configuration file cannot be read.
    """

    script: Path
    arguments: list[str]
    line: CommandLine
    module: str = ""

    def __post_init__(self) -> None:
        self.arguments = self.line.in_full(self.script, self.arguments)
        self.flags = self.line.read(self.arguments)

    def of(self, script: Path, arguments: list[str]) -> HostCommand:
        """A command for another script of the same folder; it runs as a module if this one does."""
        package = self.module.split(".")[:-1]
        module = ".".join([*package, script.stem]) if self.module else ""
        return HostCommand(script, arguments, self.line, module)

    @property
    def output(self) -> Path | None:
        """The host's output folder, or None if the command does not name it."""
        return Path(self.flags.output) if self.flags.output else None

    @property
    def iterations(self) -> int:
        """The last iteration of the host's training."""
        return int(self.flags.iterations or self.line.default_iterations)

    def checkpoints(self, last: int) -> list[int]:
        """Iterations at which to write a checkpoint: those in the command, and ``last``."""
        return sorted({*(self.flags.save_checkpoints or []), last})

    def saving(self, scratch: Path, last: int, **extra: Any) -> list[str]:
        """``with_flags``, and flags by which the host also saves its model at ``last``."""
        if self.line.checkpoints_only:
            extra["save_checkpoints"] = self.checkpoints(last)
        if self.line.config and self.flags.config:
            extra["iterations"] = last
        return self.with_flags(scratch, **extra) if extra else self.arguments

    def with_flags(self, scratch: Path, **extra: Any) -> list[str]:
        """Arguments with flags of these fields appended; argparse takes the last value of a flag.

        A host's configuration file overrides flags, so a changed copy in ``scratch`` replaces it.
        A host may read the iterations to save at before it reads the file.
        """
        given = {self.line.spellings(name)[-1]: value for name, value in extra.items()}
        out = list(self.arguments)
        for flag, value in given.items():
            values = value if isinstance(value, list) else [value]
            out += [flag, *map(str, values)]
        if self.line.config and self.flags.config:
            copy = scratch / self.flags.config.name
            overrule(self.line.config, self.flags.config, copy, given)
            out += [self.line.config.flag, str(copy)]
        return out


def split(command: list[str], *, quietly: bool = False) -> tuple[Path, list[str], str]:
    """(script, arguments, module) of a command; ``module`` is "" but of ``python -m module``."""
    words = list(command)
    if words and Path(words[0]).name.startswith("python"):
        words = _without_options(words[1:], quietly=quietly)
    if words[:1] == ["-m"] and len(words) > 1:
        return _script_of(words[1]), words[2:], words[1]
    for entry in entry_points(group="console_scripts", name=words[0]) if words else ():
        return _script_of(entry.module), words[1:], entry.module  # as pip installed the command
    if not words or not words[0].endswith(".py"):
        found = repr(" ".join(command)) if command else "none"
        expected = "-- python train.py ... (the host's script), or -- python -m package.module ..."
        remedy = "Put the host's own training command after --, and what sets variables or starts "
        raise UsageError("command", found, expected, f"{remedy}programs in front of fragprune.")
    script = Path(words[0]).resolve()
    if not script.is_file():
        raise UsageError(str(script), "no such file", "the host's script", "Check the path.")
    return script, words[1:], ""


def _without_options(words: list[str], *, quietly: bool) -> list[str]:
    """The words after the interpreter's own options, such as ``-u`` and ``-X dev``."""
    rest = list(words)
    while rest and _OPTION.fullmatch(rest[0]):
        if rest.pop(0) in ("-W", "-X"):
            rest = rest[1:]
    if not quietly and (given := words[: len(words) - len(rest)]):
        why = "the script runs in the interpreter of fragprune"
        log.warning("python %s: has no effect, because %s", " ".join(given), why)
    return rest


def _script_of(module: str) -> Path:
    """The file that ``python -m module`` runs: this folder's, or else an installed package's."""
    for repo in (HostRepo(Path.cwd()), HostRepo.installed(module.split(".")[0])):
        script = repo.path(module) if repo else None
        if script is not None and script.name == "__init__.py":
            script = repo.path(f"{module}.__main__") if repo else None
        if script is not None:
            return script
    expected = "a module in this folder or of an installed package"
    remedy = "Go to the host's folder, install the package, or check the name."
    raise UsageError(f"python -m {module}", "no such module", expected, remedy)


def overrule(config: ConfigFile, path: Path, copy: Path, given: dict[str, Any]) -> None:
    """Write a copy of a configuration file with other values, and check it by reading it."""
    values = {flag.lstrip("-"): value for flag, value in given.items()}
    copy.write_text(config.copied(path, values), encoding="utf-8")
    said = read_config(config, copy)
    if ignored := sorted(name for name in values if said.get(name) != values[name]):
        found = f"a layout to which {', '.join(ignored)} cannot be added"
        expected = "the layout of the host's own examples"
        raise UsageError(f"{config.flag} {path}", found, expected, "Write the file in that layout.")
