"""``fragprune bridge``: gives the JavaScript modules with which viewers honour cutoffs."""

from __future__ import annotations

import shutil
from importlib.metadata import EntryPoint
from pathlib import Path
from types import ModuleType

import click

from fragprune_plugins.errors import PluginError, UsageError
from fragprune_plugins.files.atomic import replacing
from fragprune_plugins.plugins.points import load, offered
from fragprune_plugins.workbench.commands.command import Command, Report
from fragprune_plugins.workbench.commands.options import FILE

GROUP = "fragprune.bridges"  # entry points: a viewer, and the package whose ``MODULE`` it is


@click.command("bridge", cls=Command)
@click.argument("viewer", required=False)
@click.option("--out", type=FILE, help="Folder to copy the module into.")
def command(viewer: str | None, out: Path | None) -> Report:
    """Write the JavaScript module that makes VIEWER honour cutoffs.

    A bridge is one module without a build step, and its folder is an npm package. Without --out
    the folder is printed. Without VIEWER all bridges are listed.

    \b
    Examples:
      fragprune bridge playcanvas --out website
      npm install "$(fragprune bridge spark)"
    """
    modules = offered(GROUP)
    if viewer is None:
        found = {name: _module(entry) for name, entry in modules.items()}
        lines = [f"{name:<16} {module}" for name, module in found.items()]
        data = {"bridges": {name: str(module) for name, module in found.items()}}
        return Report(data, "\n".join(lines) or "No bridge is installed.")
    if viewer not in modules:
        raise UsageError("VIEWER", viewer, " or ".join(modules), "Run fragprune bridge to see all.")
    module = _module(modules[viewer])
    if out is None:
        return Report({"bridge": viewer, "module": str(module)}, str(module.parent))
    to = out / module.name
    out.mkdir(parents=True, exist_ok=True)
    with replacing(to) as temporary:
        shutil.copyfile(module, temporary)
    text = (
        f"Wrote {to}. Its first lines show how a page calls installCutoffs.\n"
        "If a model has a sidecar: fragprune export MODEL.ply --out for_viewer.ply"
    )
    return Report({"bridge": viewer, "module": str(to)}, text)


def _module(point: EntryPoint) -> Path:
    """The module of an installed bridge."""
    path = Path(str(getattr(load(point, ModuleType), "MODULE", "MODULE")))
    if not path.is_file():
        expected = "a package with the path of its JavaScript module as MODULE"
        remedy = f"Install {point.value} again, or remove it."
        raise PluginError(f"{point.group} {point.name}", f"no file {path}", expected, remedy)
    return path
