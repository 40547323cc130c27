"""The files of a viewer, in a folder or in one page."""

import json
import re

import pytest
from finetune import tiny

from fragprune_plugins.errors import OutputError
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


def test_one_page_asks_for_nothing(site):
    page = sites.single_page(site).decode()
    assert 'src="' not in page
    assert 'href="style' not in page
    assert not re.search(r"^(import|export) ", page, re.MULTILINE)
    names = re.findall(r"^(?:async )?(?:function|class|const) (\w+)", page, re.MULTILINE)
    assert len(names) == len(set(names)), "modules that share a name cannot share a page"


def test_one_page_has_a_limit(site):
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
