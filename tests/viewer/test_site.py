"""The files of a viewer, in a folder, in one page, or from a server that gives nothing else."""

import http.client
import json
import re
import socket
import threading
from threading import Thread

import pytest
from finetune import tiny

from fragprune_plugins.errors import OutputError
from fragprune_plugins.workbench.view import site as serving
from fragprune_plugins.workbench.view import site as sites


@pytest.fixture
def site():
    view = tiny.cameras()[0].view()
    layers = [sites.Layer("one", 0, False)]
    return sites.make_site("a title", [tiny.random_model()], layers, [], view)


def test_every_file_that_a_page_asks_for_is_there(site, tmp_path):
    sites.save_site(tmp_path, site)
    written = {str(p.relative_to(tmp_path)): p.read_bytes() for p in tmp_path.rglob("*.*")}
    assert written == site
    text = "".join(site[name].decode() for name in site if name.endswith((".html", ".js")))
    asked = set(re.findall(r'(?:src|href|from) ?=? ?"(?:\./)?([\w-]+\.\w+)"', text))
    assert asked == {name for name in site if name.endswith((".js", ".css"))}
    assert "//" not in re.sub(r"//[^\n]*\n|http://www.w3.org", "", site["main.js"].decode())


def test_one_page_asks_for_nothing_and_has_a_limit(site):
    page = sites.single_page(site).decode()
    assert 'src="' not in page
    assert 'href="style' not in page
    assert not re.search(r"^(import|export) ", page, re.MULTILINE)
    names = re.findall(r"^(?:async )?(?:function|class|const) (\w+)", page, re.MULTILINE)
    assert len(names) == len(set(names)), "modules that share a name cannot share a page"
    site["model-0.splats"] = bytes(sites.SINGLE_MAX)
    with pytest.raises(OutputError, match="in one page"):
        sites.single_page(site)


def test_a_camera_as_the_page_has_it():
    camera = tiny.cameras()[2]
    found = sites.camera(camera.view())
    assert json.loads(json.dumps(found)) == found
    assert found["rotation"] == pytest.approx(camera.rotation.flatten().tolist(), abs=1e-6)
    centre = (-camera.rotation.T @ camera.translation).tolist()
    assert found["position"] == pytest.approx(centre, abs=1e-6)
    lens = [camera.fx, camera.fy, camera.cx, camera.cy]
    assert [found[name] for name in ("fx", "fy", "cx", "cy")] == pytest.approx(lens, rel=1e-6)


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


def test_the_page_of_another_site_reads_nothing_and_shows_no_photograph(port):
    assert ask(port, "/model-0.splats", host="example.com")[0] == 403
    status, headers, _ = ask(port, "/photographs/0000.jpg", host=f"127.0.0.1:{port}")
    assert (status, headers["Cross-Origin-Resource-Policy"]) == (200, "same-origin")


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
