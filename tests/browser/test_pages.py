"""Pages of reports and audits, as a real browser shows them: dividers, portraits, intruders."""

import pytest
import torch
from browser.chromium import opened, served
from browser.test_viewer import INTRUDE

from fragprune_plugins.workbench.figures import page
from fragprune_plugins.workbench.figures.pictures import save_image, save_map

pytestmark = pytest.mark.browser

BODY = """
<section><div class="grid">
{{ parts.pair(source.before, source.after, "pictures", (160, 60), ("original", "pruned")) }}
{{ parts.pair(source.before_map, source.after_map, "maps", (160, 60), ("original", "pruned")) }}
</div></section>
"""


def template(folder, body):
    """A page of these parts."""
    head = '{% extends "page.html" %}{% import "parts.html" as parts %}{% block body %}'
    (folder / "template.html").write_text(f"{head}{body}{{% endblock %}}")
    return folder / "template.html"


@pytest.fixture
def address(tmp_path):
    for name, level in (("before", 1.0), ("after", 0.0)):
        save_image(tmp_path / f"{name}.png", torch.full((3, 60, 160), level))
        save_map(tmp_path / f"{name}_map.png", torch.full((60, 160), level), 1.0)
    text = page.render(
        template(tmp_path, BODY),
        title="A page",
        source={each.stem: page.embedded(each) for each in tmp_path.glob("*.png")},
    )
    (tmp_path / "page.html").write_text(text + '<link rel="icon" href="data:,">')
    with served(tmp_path) as at:
        yield at + "page.html"


def split_at(picture):
    """Share of the columns in which a white picture, left of a black one, is seen."""
    row = picture[len(picture) // 4].mean(axis=-1)  # above the handle, below the names
    return float((row > 128).mean())


def test_a_divider_moves_all_pictures_of_its_view(browser, address):
    with opened(browser, address) as tab:
        pairs = tab.page.locator(".pair")
        assert pairs.count() == 2
        assert split_at(tab.picture(".pair >> nth=0")) == pytest.approx(0.5, abs=0.02)
        pairs.nth(1).scroll_into_view_if_needed()
        box = pairs.nth(1).bounding_box()
        tab.page.mouse.click(box["x"] + 0.2 * box["width"], box["y"] + 0.7 * box["height"])
        for at in range(2):
            assert split_at(tab.picture(f".pair >> nth={at}")) == pytest.approx(0.2, abs=0.04)
        tab.page.keyboard.press("End")
        assert split_at(tab.picture(".pair >> nth=0")) == pytest.approx(1.0, abs=0.02)
        assert tab.errors == tab.strangers == []


def test_what_somebody_put_into_the_page_neither_runs_nor_asks_anybody(browser, address):
    with opened(browser, address) as tab:
        refused, intruded = tab.run(INTRUDE)
        assert not intruded
        assert tab.strangers == []
        expected = ["connect-src", "frame-src", "img-src", "script-src-attr", "script-src-elem"]
        assert refused == expected  # its own style is inline, so any may be


def test_a_portrait_fits_the_window(browser, tmp_path):
    save_image(tmp_path / "tall.png", torch.zeros(3, 1920, 1080))
    body = '<div class="grid">{{ parts.picture(source, "tall", (1080, 1920)) }}</div>'
    source = page.embedded(tmp_path / "tall.png")
    text = page.render(template(tmp_path, body), title="t", source=source)
    (tmp_path / "page.html").write_text(text + '<link rel="icon" href="data:,">')
    with served(tmp_path) as at, opened(browser, at + "page.html") as tab:
        assert tab.run("document.querySelector('img').offsetHeight") <= 720
        assert tab.run("document.querySelector('img').offsetWidth") > 300
