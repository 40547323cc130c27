"""The site is built strictly, with the tutorial run; all that it refers to is there, offline."""

import json
import os
import re
import subprocess
import sys
from html.parser import HTMLParser
from pathlib import Path
from urllib.parse import unquote, urlsplit

import pytest

ROOT = Path(__file__).parents[2]

pytestmark = pytest.mark.slow

for needed in ("material", "nbclient", "ipykernel"):
    pytest.importorskip(needed, reason="needs fragprune-plugins[docs]")


class References(HTMLParser):
    """What a page loads, what it links to, and where it can be linked to."""

    def __init__(self, page: Path) -> None:
        super().__init__()
        self.loaded: list[str] = []
        self.linked: list[str] = []
        self.anchors: set[str] = set()
        self.feed(page.read_text(encoding="utf-8"))

    def handle_starttag(self, tag, attrs):
        given = dict(attrs)
        self.anchors |= {given[key] for key in ("id", "name") if given.get(key)}
        if tag == "a":
            self.linked.append(given.get("href") or "")
        else:
            self.loaded += [given[key] for key in ("src", "href") if given.get(key)]


@pytest.fixture(scope="module")
def site(tmp_path_factory):
    folder = tmp_path_factory.mktemp("site")
    words = [sys.executable, "-m", "mkdocs", "build", "--strict", "-d", str(folder)]
    how = {"cwd": ROOT, "env": os.environ | {"NO_COLOR": "1"}, "timeout": 280}
    done = subprocess.run(words, capture_output=True, text=True, **how)
    assert done.returncode == 0, (done.stdout + done.stderr)[-4000:]
    return folder


@pytest.fixture(scope="module")
def pages(site):
    """All but the page for what is not found, whose place is unknown."""
    return {page: References(page) for page in site.rglob("*.html") if page.name != "404.html"}


def test_every_link_leads_to_a_page_and_a_place_in_it(site, pages):
    lost = []
    for page, references in pages.items():
        for link in [*references.loaded, *references.linked]:
            scheme, host, path, _, anchor = urlsplit(link)
            target = (page.parent / unquote(path)).resolve() if path else page
            if scheme or host or link == ".":
                continue
            there = target.exists() and target.is_relative_to(site)
            if not there or (anchor and target in pages and anchor not in pages[target].anchors):
                lost.append((str(page.relative_to(site)), link))
    assert not [each for each in lost if not each[1].startswith("#__")]


def test_no_page_loads_anything_from_elsewhere(site, pages):
    assert not [link for each in pages.values() for link in each.loaded if urlsplit(link).netloc]
    styles = "".join(file.read_text(encoding="utf-8") for file in site.rglob("*.css"))
    assert not re.findall(r"(?:url\(|@import )[\"']?https?:[^)]*", styles)


def test_the_tutorial_shows_what_it_printed_and_drew(site):
    page = (site / "tutorial.html").read_text(encoding="utf-8")
    assert re.search(r"fragments per pixel +\d", re.sub("<[^>]+>", "", page))
    assert len(re.findall(r"<img [^>]*tutorial-\d\.png", page)) == 3
    notebook = json.loads((site / "tutorial.ipynb").read_text(encoding="utf-8"))
    assert not any(cell.get("outputs") for cell in notebook["cells"]), "strip the outputs"


def test_every_page_can_be_searched(site, pages):
    index = json.loads((site / "search" / "search_index.json").read_text(encoding="utf-8"))
    found = {entry["location"].partition("#")[0] for entry in index["docs"]}
    assert found == {str(page.relative_to(site)) for page in pages}
