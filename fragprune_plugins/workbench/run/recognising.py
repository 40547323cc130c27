"""Recognises a script that starts trainings, and one in which they cannot be served."""

from __future__ import annotations

import ast
import re
from collections.abc import Sequence
from pathlib import Path

from fragprune_plugins.errors import UsageError
from fragprune_plugins.hosts.source import HostRepo
from fragprune_plugins.injection.command import split

_SHELLS = {"sh", "bash", "zsh", "dash", "ksh"}
_STARTING = {"system", "popen", "Popen", "run", "call", "check_call", "check_output"}
_PAST = re.compile(
    r"\bactivate\b|sys\.executable|\b(conda|mamba|uv|poetry|pipenv) run\b|/python[\d.]*\s+\S+\.py"
    r"|\b(torchrun|accelerate launch|torch\.distributed|env -i)\b"
    r"|(?<![\w.-])PATH=[\"']?(?!\$\{?PATH\b|\S*cuda)"
)
"""What starts or finds another ``python`` than the first of the PATH."""
SINGLY = "Put fragprune run -- in front of each training."


def is_sweep(command: Sequence[str]) -> bool:
    """Whether a command runs a script that trains nothing itself, but starts others that do.

    UsageError if it starts them in a way in which they cannot be served.
    """
    name = Path(command[0]).name if command else ""
    if name in _SHELLS or name.endswith(".sh"):
        for script in (Path(word) for word in command if word.endswith(".sh")):
            if script.is_file():
                text = script.read_text(encoding="utf-8", errors="replace")
                _expect_seen(script, [each.partition("#")[0] for each in text.splitlines()])
        return True
    try:
        script, _, _ = split(list(command), quietly=True)
    except UsageError:  # told where the command is run
        return False
    started = _started_by(HostRepo(script.parent), script)
    _expect_seen(script, started)
    return bool(started)


def _expect_seen(script: Path, lines: Sequence[str]) -> None:
    """Refuse a script that would not find our ``python``."""
    for line in lines:
        if _PAST.search(line):
            found = f"{line.strip()!r}, which starts a python that fragprune does not see"
            expected = "the word python alone, in an environment that is active already"
            raise UsageError(str(script), found, expected, f"Take that out, or: {SINGLY}")


def _started_by(here: HostRepo, script: Path) -> list[str]:
    """What a Python script starts, if a training is among it and it has no model itself."""
    text, tree = here.read(script), here.tree(script.stem)
    if ".backward(" in text or "GaussianModel" in text or tree is None:
        return []
    nodes = list(ast.walk(tree))
    calls = {getattr(each.func, "attr", "") for each in nodes if isinstance(each, ast.Call)}
    said = [each.value for each in nodes if isinstance(each, ast.Constant)]
    named = [each for each in said if isinstance(each, str) and re.search(r"\w\.py\b", each)]
    if not (calls & _STARTING and any(re.search(r"train\w*\.py\b", each) for each in named)):
        return []
    return named + re.findall("sys.executable", text)
