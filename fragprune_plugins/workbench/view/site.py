"""The files of a viewer: to serve, to write into a folder, or to put into one page.

It is served to this machine only, and what is not among its files does not exist for it.
"""

from __future__ import annotations

import base64
import contextlib
import io
import json
import re
import sys
from collections.abc import Sequence
from dataclasses import dataclass
from functools import partial
from http import HTTPStatus
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path
from typing import Any
from urllib.parse import unquote

import torch

from fragprune_plugins.errors import OutputError
from fragprune_plugins.files.atomic import replacing
from fragprune_plugins.files.model import Model
from fragprune_plugins.types import View
from fragprune_plugins.workbench.figures.page import allowed
from fragprune_plugins.workbench.figures.pictures import picture
from fragprune_plugins.workbench.models.model import writable_folder
from fragprune_plugins.workbench.scenes.dataset import Shot
from fragprune_plugins.workbench.scenes.generated import Named, bounds
from fragprune_plugins.workbench.view.packing import compact, pack

Site = dict[str, bytes]  # names of files, with slashes, and what they hold
STATIC = Path(__file__).parent / "static"
SINGLE_MAX = 64 << 20  # most bytes of models and photographs that one page holds: a page of 80 MiB
_SAFE = bytes.maketrans(b"<&", b",.")  # of base 85, so that no text ends or hides an element
_MODULES = ("shaders", "compact", "sorting", "splats", "camera", "drawing", "main")  # in this order
_PHOTOGRAPH_SIDE = 960


@dataclass(frozen=True)
class Layer:
    """One of at most two sides of the picture."""

    name: str
    model: int
    truncated: bool  # whether its thresholds apply


def make_site(
    title: str,
    models: Sequence[Model],
    layers: Sequence[Layer],
    cameras: Named,
    start: View,
    photographs: Sequence[Shot] = (),
) -> Site:
    """All files of a viewer: of one or two layers from left to right, cameras to choose from, if
    there are any, the first camera, whose background is the page's, and what the cameras took.
    """
    site = {each.name: each.read_bytes() for each in sorted(STATIC.iterdir()) if each.is_file()}
    described = []
    for number, model in enumerate(models):
        file = f"model-{number}.splats"
        site[file], facts = pack(model)
        described.append({"file": file, **facts})
    centre, radius = bounds(models[0])
    listed = []
    for number, (name, view) in enumerate(cameras):
        taken = f"photographs/{number:04d}.jpg" if photographs else None
        listed.append({"name": name, **camera(view), "photograph": taken})
        if taken:
            site[taken] = _jpeg(photographs[number])
    scene = {
        "title": title,
        "models": described,
        "layers": [vars(each) for each in layers],
        "cameras": listed,
        "start": listed[0] if cameras and start is cameras[0][1] else camera(start),
        "background": start.background.tolist(),
        "up": [0.0, -1.0, 0.0],  # as in COLMAP's worlds
        "centre": centre.tolist(),
        "radius": radius,
    }
    site["scene.json"] = json.dumps(scene, allow_nan=False).encode()
    return site


def camera(view: View) -> dict[str, Any]:
    """A view as the page has it: lens in pixels, rotation from world to camera, row by row."""
    lens = torch.linalg.solve(view.viewmatrix.double(), view.projmatrix.double())
    return {
        "width": view.width,
        "height": view.height,
        "fx": view.width / (2 * view.tan_fov_x),
        "fy": view.height / (2 * view.tan_fov_y),
        "cx": (float(lens[2, 0]) + 1) * view.width / 2,
        "cy": (float(lens[2, 1]) + 1) * view.height / 2,
        "rotation": view.viewmatrix[:3, :3].T.flatten().tolist(),
        "position": view.campos.tolist(),
    }


def save_site(folder: Path, site: Site) -> None:
    """Write a viewer's files into a folder, which any web server can serve."""
    for name, content in site.items():
        path = Path(folder, *name.split("/"))
        writable_folder(path.parent)
        with replacing(path) as temporary:
            temporary.write_bytes(content)


def compacted(site: Site) -> tuple[Site, list[str]]:
    """The same viewer with models that take few bytes, and what was rounded for that."""
    scene, small = json.loads(site["scene.json"]), dict(site)
    rounded: list[str] = []
    for facts in scene["models"]:
        with contextlib.suppress(OverflowError):
            small[facts["file"]], more, names = compact(site[facts["file"]], facts)
            facts |= more
            rounded += names
    small["scene.json"] = json.dumps(scene, allow_nan=False).encode()
    return small, list(dict.fromkeys(rounded))


def single_page(site: Site) -> bytes:
    """A viewer, better ``compacted``, as one HTML file to open from disk, up to ``SINGLE_MAX``."""
    data = {name: each for name, each in site.items() if not (STATIC / name).is_file()}
    size = sum(map(len, data.values()))
    if size > SINGLE_MAX:
        expected = f"at most {SINGLE_MAX >> 20} MiB in one page"
        raise OutputError("--out", f"{size >> 20} MiB of data", expected, "Name a folder.")
    # Names of all modules differ, so that one after the other they are one module.
    modules = "\n".join(site[f"{name}.js"].decode() for name in _MODULES)
    code = re.sub(r"^(import .*|export (?=\w))", "", modules, flags=re.MULTILINE)
    held = "".join(
        f'<script type="text/plain" data-name="{name}">{_text(name, each)}</script>\n'
        for name, each in data.items()
    )
    style = site["style.css"].decode()
    page = site["index.html"].decode()
    script = f'{held}<script type="module">{code}</script>'
    for before, after in (
        ("script-src 'self'", f"script-src {allowed(code)}"),
        ("style-src 'self'", f"style-src {allowed(style)}"),
        ("connect-src 'self'; img-src 'self' data:", "img-src data:"),
        ('<link rel="stylesheet" href="style.css">', f"<style>{style}</style>"),
        ('<script type="module" src="main.js"></script>', script),
    ):
        page = page.replace(before, after, 1)
    return page.encode()


def _jpeg(photograph: Shot) -> bytes:
    """A photograph as a JPEG of at most ``_PHOTOGRAPH_SIDE`` pixels a side; none is enlarged."""
    image, held = picture(photograph.image), io.BytesIO()
    image.thumbnail((_PHOTOGRAPH_SIDE, _PHOTOGRAPH_SIDE))
    image.save(held, format="JPEG", quality=88)
    return held.getvalue()


def _text(name: str, data: bytes) -> str:
    """Bytes as text of a page: photographs as browsers read them, the rest in less."""
    jpeg = name.endswith(".jpg")
    return (base64.b64encode(data) if jpeg else base64.b85encode(data).translate(_SAFE)).decode()


HOST = "127.0.0.1"
_KINDS = {"json": "application/json", "jpg": "image/jpeg"}
_KINDS |= {end: f"text/{end}; charset=utf-8" for end in ("html", "css")}
_KINDS["js"] = "text/javascript; charset=utf-8"


def open_server(site: Site, port: int = 0) -> ThreadingHTTPServer:
    """A server of these files at 127.0.0.1; port 0 takes a free one. OutputError if it is taken."""
    try:
        return _Server((HOST, port), partial(_Handler, site))
    except OSError as error:
        found = error.strerror or str(error)
        raise OutputError(f"{HOST}:{port}", found, "a free port", "Leave out --port.") from error


def address(server: ThreadingHTTPServer) -> str:
    """Where a browser on this machine finds the viewer."""
    return f"http://{HOST}:{server.server_port}/"


class _Server(ThreadingHTTPServer):
    def handle_error(self, request: Any, client_address: Any) -> None:
        """Say nothing of a browser that goes away before it has read its answer."""
        if not isinstance(sys.exc_info()[1], ConnectionError):
            super().handle_error(request, client_address)


_HEADERS = {
    "Cache-Control": "no-store",
    "Content-Security-Policy": "frame-ancestors 'none'",  # the page itself says the rest
    "X-Content-Type-Options": "nosniff",
    "Cross-Origin-Resource-Policy": "same-origin",
}


class _Handler(BaseHTTPRequestHandler):
    protocol_version = "HTTP/1.1"

    def __init__(self, site: Site, *words: Any) -> None:
        self.site = site
        super().__init__(*words)

    def do_GET(self) -> None:
        """Answer with a file; HEAD as GET, without the file."""
        port = self.connection.getsockname()[1]
        if self.headers.get("Host") not in (f"{HOST}:{port}", f"localhost:{port}"):
            # A page of another site that has its name point here may not read the model.
            self.send_error(HTTPStatus.FORBIDDEN)
            return
        name = unquote(self.path.partition("?")[0])[1:] or "index.html"
        content = self.site.get(name)
        if content is None:
            self.send_error(HTTPStatus.NOT_FOUND)
            return
        self.send_response(HTTPStatus.OK)
        kind = _KINDS.get(name.rpartition(".")[2], "application/octet-stream")
        length = {"Content-Type": kind, "Content-Length": str(len(content))}
        for header, value in (length | _HEADERS).items():
            self.send_header(header, value)
        self.end_headers()
        if self.command == "GET":
            self.wfile.write(content)

    do_HEAD = do_GET  # noqa: N815 - the name that its base class looks for

    def log_message(self, *words: Any) -> None:
        """Say nothing: the terminal is the command's."""
