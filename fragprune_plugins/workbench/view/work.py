"""Makes the viewer's page of one or two models, and serves or writes it."""

from __future__ import annotations

import webbrowser
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import click

from fragprune_plugins.errors import OutputError
from fragprune_plugins.files.reading import lies_in
from fragprune_plugins.workbench.commands import opening
from fragprune_plugins.workbench.commands.command import Report
from fragprune_plugins.workbench.commands.options import SceneOptions
from fragprune_plugins.workbench.figures import records
from fragprune_plugins.workbench.figures.viewing import overview
from fragprune_plugins.workbench.figures.wording import quoted
from fragprune_plugins.workbench.models.model import load, writable_folder
from fragprune_plugins.workbench.scenes.cameras import load_cameras
from fragprune_plugins.workbench.scenes.dataset import Shot, load_photographs
from fragprune_plugins.workbench.scenes.generated import Named
from fragprune_plugins.workbench.scenes.output import cameras_of, output_folder
from fragprune_plugins.workbench.view import site as sites


def view(
    *,
    model: Path,
    other: Path | None,
    data: Path | None,
    cameras: Path | None,
    out: Path | None,
    white_background: bool,
    port: int,
    no_browser: bool,
) -> Report:
    """Do what ``fragprune view`` promises; its options are the arguments."""
    single = out is not None and out.suffix.lower() in (".html", ".htm")
    if out is not None:
        _expect_our_page(out if single else out / "index.html")
        writable_folder(out.parent if single else out)
    other = other or _original(model)
    paths = [each for each in (model, other) if each is not None]
    models = [load(each) for each in paths]
    opening.warn_if_antialiased(*paths)
    truncated = [each.falloff is not None for each in models]
    if truncated == [True, False]:  # the original stands left of the split
        for each in (paths, models, truncated):
            each.reverse()
    scene = SceneOptions(data, white_background=white_background)
    scene = opening.over_its_background(model, scene)
    shown, shots = _cameras(scene, cameras or cameras_of(model), paths)
    start = shown[0][1] if shown else overview(models[-1])
    if not shown:
        start.background.fill_(float(scene.white_background))
    site = sites.make_site(model.name, models, _layers(paths, truncated), shown, start, shots)
    facts: dict[str, Any] = {
        "model": str(model),
        "compare": None if other is None else str(other),
        "gaussians": [len(each) for each in models],
        "truncated": truncated,
        "cameras": len(shown),
        "bytes": sum(map(len, site.values())),
        "address": None,
        "files": [],
        "rounded": [],
    }
    if out is None:
        address = _serve(site, port, browse=not no_browser)
        return Report(facts | {"address": address}, "The viewer is closed.")
    site, rounded = sites.compacted(site)
    if single:
        site = {out.name: sites.single_page(site)}
        what, then = str(out), "Open it in a browser."
    else:
        what = f"{len(site)} files to {out}"
        then = f"A web server has to serve them; here: python -m http.server -d {quoted(out)}"
    folder = out.parent if single else out
    sites.save_site(folder, site)
    size, files = sum(map(len, site.values())), [str(folder / name) for name in sorted(site)]
    facts |= {"bytes": size, "files": files, "rounded": rounded}
    how = f", with {', '.join(rounded)} rounded as in a .spz file" if rounded else ""
    return Report(facts, f"Wrote {what} ({size / 2**20:.1f} MiB){how}. {then}")


def _original(model: Path) -> Path | None:
    """The model that a fine-tuning began with, by its record, if it lies in the same folder."""
    if (record := records.beside(model)) is None:
        return None
    with records.RECORD_FILE.stated(record.path):
        name = record.data.get("model_before", record.data.get("model"))
        original = None if name is None else records.located(name, record.path.parent)
    inside = output_folder(model) or model.parent  # a record may be somebody else's
    if original and original.is_file() and lies_in(original, inside):
        return None if original.samefile(model) else original
    return None


def _layers(paths: list[Path], truncated: list[bool]) -> list[sites.Layer]:
    """The sides of the split, from left to right."""
    if len(paths) == 1:
        pruned = [sites.Layer("No cutoffs", 0, False), sites.Layer("Pruned", 0, True)]
        return pruned if truncated[0] else [sites.Layer(paths[0].stem, 0, False)]
    names = ("Original", "Pruned") if truncated == [False, True] else _told_apart(*paths)
    return [sites.Layer(name, index, truncated[index]) for index, name in enumerate(names)]


def _told_apart(left: Path, right: Path) -> tuple[str, str]:
    """Names of two files: the first folder or name from the end in which their paths differ."""
    ends = (reversed(path.with_suffix("").parts) for path in (left, right))
    for one, other in zip(*ends, strict=False):
        if one != other:
            return one, other
    return str(left), str(right)


def _cameras(
    scene: SceneOptions, cameras: Path | None, models: list[Path]
) -> tuple[Named, Sequence[Shot]]:
    """The cameras of the page's list: held-out ones of a scene, and what they took, or a file's."""
    if scene.data is not None:
        shots = load_photographs(opening.drawn_as_trained(scene, *models)).test
        return [(shot.name, shot.view) for shot in shots], shots
    white = scene.white_background
    return load_cameras(cameras, white_background=white) if cameras else [], ()


def _serve(site: sites.Site, port: int, *, browse: bool) -> str:
    """Serve until Ctrl-C; gives the address."""
    with sites.open_server(site, port) as server:
        where = sites.address(server)
        click.echo(f"The viewer is at {where} until Ctrl-C.", err=True)
        if browse:
            webbrowser.open(where)
        try:
            server.serve_forever()
        except KeyboardInterrupt:
            click.echo("", err=True)
        return where


def _expect_our_page(page: Path) -> None:
    """Raise OutputError if another page has the name of ours."""
    if page.is_file() and b'content="fragprune view"' not in page.read_bytes()[:4096]:
        found = "a page that fragprune view did not write"
        expected = "no page there, or one of fragprune view"
        raise OutputError(str(page), found, expected, "Choose another --out, or delete the page.")
