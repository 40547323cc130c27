"""The server gives its own files to its own machine, and nothing else to anybody."""

import http.client
import socket
import threading
from threading import Thread

import pytest

from fragprune_plugins.errors import OutputError
from fragprune_plugins.workbench.view import site as serving

SITE = {"index.html": b"<p>here", "model-0.splats": bytes(range(7)), "photographs/0000.jpg": b"jpg"}


@pytest.fixture(scope="module")
def port():
    server = serving.open_server(SITE)
    thread = Thread(target=server.serve_forever)
    thread.start()
    yield server.server_port
    server.shutdown()
    server.server_close()
    thread.join()


def ask(port, path, method="GET", host=None):
    connection = http.client.HTTPConnection(serving.HOST, port, timeout=10)
    connection.putrequest(method, path, skip_host=True)
    connection.putheader("Host", host or f"localhost:{port}")
    connection.endheaders()
    answer = connection.getresponse()
    held = answer.read()
    connection.close()
    return answer.status, answer.headers, held


@pytest.mark.parametrize(
    ("path", "name", "kind"),
    [
        ("/", "index.html", "text/html; charset=utf-8"),
        ("/index.html?full", "index.html", "text/html; charset=utf-8"),
        ("/model-0.splats", "model-0.splats", "application/octet-stream"),
        ("/photographs/0000.jpg", "photographs/0000.jpg", "image/jpeg"),
    ],
)
def test_its_files(port, path, name, kind):
    status, headers, held = ask(port, path)
    assert (status, held, headers["Content-Type"]) == (200, SITE[name], kind)
    assert headers["Content-Security-Policy"] == "frame-ancestors 'none'"  # the page has the rest
    status, headers, held = ask(port, path, "HEAD")
    assert (status, held, headers["Content-Length"]) == (200, b"", str(len(SITE[name])))


@pytest.mark.parametrize(
    "path",
    [
        *("/../../../../etc/passwd", "/%2e%2e/%2e%2e/etc/passwd", "//etc/passwd", "/photographs/"),
        *("/photographs/../index.html", "/..%2findex.html", "/C:/x", "/index.html%00"),
    ],
)
def test_no_other_file_exists(port, path):
    assert ask(port, path)[0] == 404


def test_the_page_of_another_site_reads_nothing(port):
    assert ask(port, "/model-0.splats", host="example.com")[0] == 403
    assert ask(port, "/model-0.splats", host=f"127.0.0.1:{port}")[0] == 200


def test_a_port_that_is_taken(port):
    with pytest.raises(OutputError, match=r"127\.0\.0\.1"):
        serving.open_server(SITE, port)


@pytest.mark.parametrize("path", ["http://[", "//[", "http://127.0.0.1/etc/passwd", "*", "/?/.."])
def test_an_address_that_is_none_gets_an_answer_and_no_traceback(port, path, capfd):
    assert ask(port, path)[0] in (200, 404)
    assert capfd.readouterr().err == ""


def test_a_browser_that_goes_away_is_not_worth_a_word(capfd):
    others = threading.enumerate()
    with serving.open_server({"index.html": bytes(64 << 20)}) as server:
        thread = Thread(target=server.serve_forever)
        thread.start()
        for _ in range(3):
            browser = socket.create_connection(server.server_address)
            asked = f"GET / HTTP/1.1\r\nHost: localhost:{server.server_port}\r\n\r\n"
            browser.sendall(asked.encode())
            browser.recv(10)
            browser.close()
        assert ask(server.server_port, "/", "HEAD")[0] == 200
        server.shutdown()
        thread.join()
    for thread in threading.enumerate():  # of the answers that nobody reads
        if thread not in others:
            thread.join(timeout=5)
    assert "Traceback" not in capfd.readouterr().err


def test_no_page_of_another_site_shows_a_photograph(port):
    headers = ask(port, "/photographs/0000.jpg")[1]
    assert headers["Cross-Origin-Resource-Policy"] == "same-origin"
