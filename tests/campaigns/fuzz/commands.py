"""Commands on a scene of which one file is broken, as readers of that file."""

import atexit
import json
import shutil
import tempfile
from functools import cache
from pathlib import Path

import torch
from campaigns.fuzz.readers import Nonsense, Reader
from cli.commands import run
from finetune import tiny

from fragprune_plugins.errors import UsageError
from fragprune_plugins.files import sidecar
from fragprune_plugins.learning.thresholds import ThresholdStore
from fragprune_plugins.workbench.models.formats.ply import write_ply

SURFACES = {
    "model.ply": ("render", "export"),
    f"model{sidecar.SUFFIX}": ("render", "finetune"),
    "data/sparse/0/cameras.bin": ("render",),
    "data/sparse/0/images.bin": ("render",),
    "data/images/view01.png": ("profile",),
    "cameras.json": ("orbit",),
    "tuned.fragprune.json": ("report", "compare"),
}
"""By the file that is broken: the commands that read it."""

NAMES = ("render", "orbit", "profile", "compare", "finetune", "export", "report")


@cache
def scene() -> Path:
    """COLMAP data, a model of 40 Gaussians with a sidecar, a fine-tuned one, and cameras."""
    folder = Path(tempfile.mkdtemp(prefix="fuzz-scene-"))
    atexit.register(shutil.rmtree, folder)
    truth = tiny.random_model(40)
    tiny.write_colmap(folder / "data", tiny.photographs(truth), binary=True)
    write_ply(folder / "model.ply", truth)
    store = ThresholdStore.from_falloff(torch.full((40,), 0.3))
    sidecar.save(folder / "model.ply", store, settings={"iterations": 3})
    (folder / "cameras.json").write_text(json.dumps(tiny.host_cameras(tiny.cameras(1))))
    command("finetune", folder)
    return folder


def command(name: str, folder: Path) -> None:
    """Run one on a scene; raises what it states, and what nobody can use."""
    model, tuned = folder / "model.ply", folder / "tuned.ply"
    data, out = ["--data", folder / "data"], ["--out", folder / "out"]
    words = {
        "render": ["render", model, *data, *out, "--views", "all"],
        "orbit": ["render", model, "--cameras", folder / "cameras.json", *out],
        "profile": ["profile", model, *data, "--views", "all"],
        "compare": ["compare", model, tuned],
        "finetune": ["finetune", model, *data, "--out", tuned, "--iters", 1, "--again"],
        "export": ["export", model, "--out", folder / "e.ply"],
        "report": ["report", folder],
    }[name]
    done = run(*words, "--json")
    try:
        printed = json.loads(done.stdout)
    except ValueError as error:
        raise Nonsense(f"--json printed {done.stdout[:80]!r}") from error
    if done.exit_code:
        error = printed["error"]
        raise UsageError(*(error[part] for part in ("where", "found", "expected", "remedy")))


class OnFile(Reader):
    """A command, named with the file of the scene that is broken."""

    def pool(self) -> list[bytes]:
        return [(scene() / self.name.partition(" ")[2]).read_bytes()]


def _on(name: str, place: str) -> OnFile:
    def read(file: Path) -> None:
        folder = file.with_name("scene")
        shutil.copytree(scene(), folder)
        file.replace(folder / place)
        command(name, folder)

    return OnFile(f"{name} {place}", read)


COMMANDS = [_on(name, place) for place, names in SURFACES.items() for name in names]
