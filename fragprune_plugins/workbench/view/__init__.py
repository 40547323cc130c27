"""``fragprune view``: a model in the browser, pruned beside unpruned."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from fragprune_plugins.errors import OutputError, UsageError
from fragprune_plugins.workbench.commands.common import CAMERAS_HELP, FILE, MODEL, Command, Report

if TYPE_CHECKING:
    from fragprune_plugins.workbench.view.site import Shown, Site


@click.command("view", cls=Command)
@click.argument("model", type=MODEL)
@click.option("--compare", type=MODEL, help="Another model, shown on the right side of the split.")
@click.option(
    "--data", type=FILE, help="Scene folder: its held-out cameras, with their photographs."
)
@click.option(
    "--cameras",
    type=FILE,
    help=f"{CAMERAS_HELP}, if there is one.",
)
@click.option("--out", type=FILE, help="Write the viewer into this folder instead of serving it.")
@click.option("--single-file", is_flag=True, help="With --out: one HTML file that holds it all.")
@click.option("--white-background", is_flag=True, help="Show the model over white.")
@click.option(
    "--port",
    type=click.IntRange(0, 65535),
    default=0,
    show_default="any free one",
    help="Port to serve at, on 127.0.0.1.",
)
@click.option("--no-browser", is_flag=True, help="Open no browser; print the address only.")
def command(
    model: Path,
    compare: Path | None,
    data: Path | None,
    cameras: Path | None,
    out: Path | None,
    single_file: bool,
    white_background: bool,
    port: int,
    no_browser: bool,
) -> Report:
    """Look at MODEL in the browser, with fragments, overdraw and frame times.

    A model with thresholds is shown twice, with and without them, on both sides of a split. With
    --compare the right side is another model. The page needs WebGL2 and no network: it is served
    to this machine only, until Ctrl-C. With --out it is a folder that any web server can serve.

    \b
    Examples:
      fragprune view pruned.ply
      fragprune view pruned.ply --compare point_cloud.ply --data scene
      fragprune view pruned.ply --out page --single-file
      fragprune view out                                (the output folder of a training)
    """
    if data is not None and cameras is not None:
        raise UsageError("options", "both --data and --cameras", "one of them", "Pass one.")
    if single_file and out is None:
        raise UsageError("--single-file", "no --out", "a folder for the page", "Add --out DIR.")

    import torch

    from fragprune_plugins.files.atomic import replacing, writable_folder
    from fragprune_plugins.workbench.figures.viewing import overview
    from fragprune_plugins.workbench.models import model as models
    from fragprune_plugins.workbench.view.site import Layer, make_site, save_site, single_page

    if out is not None:
        _spare_other_pages(out)
        writable_folder(out)
    loaded = [models.load(each) for each in (model, compare) if each is not None]
    truncated = [each.falloff is not None for each in loaded]
    if compare is not None:
        names = [model.stem, compare.stem]
        if names[0] == names[1]:
            names = [str(model), str(compare)]
        layers = [Layer(name, i, truncated[i]) for i, name in enumerate(names)]
    elif truncated[0]:
        layers = [Layer("Truncated", 0, True), Layer("Untruncated", 0, False)]
    else:
        layers = [Layer(model.stem, 0, False)]
    shown = _cameras(data, cameras or _of_training(model), white_background)
    if shown:
        start = shown[0].view
    else:
        start = overview(loaded[0])
        start.background.copy_(torch.full((3,), float(white_background)))
    site = make_site(model.name, loaded, layers, shown, start)
    size = sum(map(len, site.values()))
    facts: dict[str, Any] = {
        "model": str(model),
        "compare": None if compare is None else str(compare),
        "gaussians": [len(each) for each in loaded],
        "truncated": truncated,
        "cameras": len(shown),
        "bytes": size,
    }
    if out is None:
        where = _serve(site, port, browse=not no_browser)
        return Report({**facts, "address": where, "files": []}, "The viewer is closed.")
    if single_file:
        page = single_page(site)
        with replacing(out / "index.html") as temporary:
            temporary.write_bytes(page)
        facts["bytes"] = len(page)
        files = [out / "index.html"]
        text = f"Wrote {files[0]} ({len(page) / 2**20:.1f} MiB): open it in a browser."
    else:
        save_site(out, site)
        files = [out / name for name in sorted(site)]
        text = (
            f"Wrote {len(files)} files to {out} ({size / 2**20:.1f} MiB). A web server "
            f"has to serve them; here: python -m http.server -d {out}"
        )
    return Report({**facts, "address": None, "files": [str(file) for file in files]}, text)


def _cameras(data: Path | None, cameras: Path | None, white_background: bool) -> list[Shown]:
    """The cameras of the page's list: held-out ones of a scene, or all of a file."""
    from fragprune_plugins.workbench.scenes.cameras import load_cameras
    from fragprune_plugins.workbench.scenes.dataset import load_dataset
    from fragprune_plugins.workbench.view.site import Shown

    if data is not None:
        shots = load_dataset(data, white_background=white_background).test
        return [Shown(shot.name, shot.view, shot) for shot in shots]
    if cameras is not None:
        named = load_cameras(cameras, white_background=white_background)
        return [Shown(name, view) for name, view in named]
    return []


def _of_training(model: Path) -> Path | None:
    """The cameras that a host wrote beside a model; None if there are none."""
    from fragprune_plugins.workbench.scenes.output import CAMERAS, output_folder

    folder = output_folder(model)
    return folder / CAMERAS if folder is not None and (folder / CAMERAS).is_file() else None


def _serve(site: Site, port: int, *, browse: bool) -> str:
    """Serve until Ctrl-C; gives the address."""
    import webbrowser

    from fragprune_plugins.workbench.view.server import address, open_server

    with open_server(site, port) as server:
        where = address(server)
        click.echo(f"The viewer is at {where} until Ctrl-C.", err=True)
        if browse:
            webbrowser.open(where)
        try:
            server.serve_forever()
        except KeyboardInterrupt:
            click.echo("", err=True)
        return where


def _spare_other_pages(out: Path) -> None:
    """Raise OutputError if the folder has a page of somebody else's under our page's name."""
    page = out / "index.html"
    if not page.is_file():
        return
    with open(page, "rb") as file:
        ours = b'content="fragprune view"' in file.read(4096)
    if not ours:
        raise OutputError(
            str(page),
            "a page that fragprune view did not write",
            "a folder of its own",
            "Name one.",
        )
