"""Serves a viewer to this machine only. What is not among its files does not exist for it."""

from __future__ import annotations

import sys
from functools import partial
from http import HTTPStatus
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from typing import Any
from urllib.parse import unquote

from fragprune_plugins.errors import OutputError
from fragprune_plugins.workbench.view.site import Site

HOST = "127.0.0.1"

_KINDS = {
    "html": "text/html; charset=utf-8",
    "css": "text/css; charset=utf-8",
    "js": "text/javascript; charset=utf-8",
    "json": "application/json",
    "jpg": "image/jpeg",
}


def open_server(site: Site, port: int = 0) -> ThreadingHTTPServer:
    """A server of these files, bound to 127.0.0.1; ``serve_forever`` runs it.

    Args:
        port: 0 for any free one.

    Raises:
        OutputError: the port cannot be had.
    """
    try:
        return _Server((HOST, port), partial(_Handler, site))
    except OSError as error:
        raise OutputError(
            f"{HOST}:{port}", error.strerror or str(error), "a free port", "Leave out --port."
        ) from error


def address(server: ThreadingHTTPServer) -> str:
    """Where a browser on this machine finds the viewer."""
    return f"http://{HOST}:{server.server_port}/"


class _Server(ThreadingHTTPServer):
    def handle_error(self, request: Any, client_address: Any) -> None:
        """Say nothing of a browser that goes away before it has read its answer."""
        if not isinstance(sys.exc_info()[1], ConnectionError):
            super().handle_error(request, client_address)


class _Handler(BaseHTTPRequestHandler):
    protocol_version = "HTTP/1.1"

    def __init__(self, site: Site, *words: Any) -> None:
        self.site = site
        super().__init__(*words)

    def do_GET(self) -> None:
        """Answer with a file."""
        self._answer(with_body=True)

    def do_HEAD(self) -> None:
        """Answer as to GET, without the file."""
        self._answer(with_body=False)

    def _answer(self, *, with_body: bool) -> None:
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
        self.send_header("Content-Type", kind)
        self.send_header("Content-Length", str(len(content)))
        self.send_header("Cache-Control", "no-store")
        # The page has a policy of its own; only a header can say who may frame it.
        self.send_header("Content-Security-Policy", "frame-ancestors 'none'")
        self.send_header("X-Content-Type-Options", "nosniff")
        self.send_header("Cross-Origin-Resource-Policy", "same-origin")
        self.end_headers()
        if with_body:
            self.wfile.write(content)

    def log_message(self, *words: Any) -> None:
        """Say nothing: the terminal is the command's."""
