"""A training that no adapter fits, but whose PLY is plain 3DGS: found without torch."""

from __future__ import annotations

import re
import subprocess
import sys
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from fragprune_plugins.errors import HostFailed
from fragprune_plugins.hosts import adapter, choosing, source
from fragprune_plugins.hosts.photographs import Photographs
from fragprune_plugins.injection.command import split
from fragprune_plugins.learning.interruption import Terminate, sigterm_interrupts
from fragprune_plugins.plugins.loading import load_plugins
from fragprune_plugins.workbench.saved import models_of
from fragprune_plugins.workbench.scenes.output import told_by

BY_HAND = "fragprune finetune MODEL.ply --data SCENE --out pruned.ply learns on any that is there."


@dataclass(frozen=True)
class Unserved:
    """A training command of a codebase that no adapter fits, and whose PLY is plain 3DGS."""

    program: tuple[str, ...]  # the words of the command that name what the interpreter runs
    arguments: tuple[str, ...]  # those after them
    output: Path | None  # the folder that it names as 3DGS does; None if it names none
    photographs: Photographs | None  # likewise, and how it reads them
    why: str  # what speaks against the nearest adapter
    unlike: str = ""  # why its model's pictures may differ from the photographs; see ``Plain``

    def train(self, *, quietly: bool) -> None:
        """Run the command in a process of its own; with ``quietly`` it prints to stderr."""
        words = [sys.executable, *self.program, *self.arguments]
        with sigterm_interrupts(), subprocess.Popen(words, stdout=2 if quietly else None) as host:
            try:
                code = host.wait()
            except KeyboardInterrupt as signal:  # a terminal sends it to the host, too
                if isinstance(signal, Terminate):
                    host.terminate()
                host.wait()
                raise
        if code:
            remedy = "No adapter serves it, so it trains by its own rasterizer alone. Look above."
            raise HostFailed(self.program[-1], f"exit code {code}", "a training to its end", remedy)

    def saved(self, since: float) -> Path:
        """The PLY that it wrote last, since a time; below its folder lie others made of it."""
        folder = self.output or Path.cwd()
        found = [each for each in folder.rglob("point_cloud.ply") if each.stat().st_mtime >= since]
        if not found:
            what = f"no point_cloud.ply in {folder}" + (" since it began" if since else "")
            raise HostFailed(self.program[-1], what, "the model that it trained", BY_HAND)
        return max(found, key=lambda each: (-len(each.parts), each.stat().st_mtime))


def unserved(command: Sequence[str]) -> Unserved | None:
    """The command, if it trains, no adapter fits its codebase, and that saves plain 3DGS."""
    script, arguments, module = split(list(command), quietly=True)
    here, plugins = source.HostRepo(script.parent), load_plugins()
    trains = "train" in script.stem or ".backward(" in here.read(script)
    folders = [here, *choosing.folder_above(here)] if trains else []
    found = ((each, models_of(each, plugins)[0]) for each in folders)
    repo, own = next((pair for pair in found if pair[1]), (here, None))
    models = set(re.findall(r"\b\w*GaussianModel\w*", here.read(script)))
    if own is None or (models and own.model not in models):  # another may save other columns
        return None
    tried = choosing.attempt(repo, plugins.adapters)
    if any(match.fits for match in tried.values()):
        return None
    program = ("-m", module) if module else (str(script),)
    parser = adapter.Flags(add_help=False, allow_abbrev=False)
    parser.add_argument("-m", "--model_path", type=Path)
    parser.add_argument("-s", "--source_path")
    parser.add_argument("-i", "--images", default="images")
    parser.add_argument("-r", "--resolution", type=float, default=-1)
    parser.add_argument("-w", "--white_background", action="store_true")
    flags = vars(parser.parse_known_args(arguments)[0])
    photographs = told_by(flags) if flags["source_path"] else None
    why = next(iter(tried.values())).brief() if tried else "none is installed"
    output = flags["model_path"]
    return Unserved(program, tuple(arguments), output, photographs, why, own.unlike)
