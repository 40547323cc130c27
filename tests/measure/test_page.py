"""The frame of all pages."""

import re
from html.parser import HTMLParser

import pytest
import torch
from hypothesis import example, given, settings
from hypothesis import strategies as st
from jinja2 import UndefinedError
from PIL import Image

from fragprune_plugins.workbench.figures import page
from fragprune_plugins.workbench.figures.pictures import colour_stops, save_map

VOID = {"meta", "img", "input", "link", "br"}


class Reader(HTMLParser):
    """The words of a page; fails where tags do not close."""

    def __init__(self):
        super().__init__()
        self.open, self.words = [], []

    def handle_starttag(self, tag, attrs):
        if tag not in VOID:
            self.open.append(tag)

    def handle_endtag(self, tag):
        assert self.open.pop() == tag

    def handle_data(self, data):
        self.words.append(data)


def read(text):
    reader = Reader()
    reader.feed(text)
    reader.close()
    assert reader.open == []
    return "".join(reader.words)


EVERY_PART = """{% extends "page.html" %}
{% import "parts.html" as parts %}
{% block body %}
<p>{{ words }}</p>
{{ parts.table(table) }}
{{ parts.picture("a.png", words, (10, 9)) }}
{{ parts.pair("a", "b", words, (9, 10), (words, words)) }}
{{ parts.plot("a.png", words) }}
{{ parts.legend(words, 3.0) }}
{{ parts.facts([(words, words)]) }}
{% endblock %}
"""


@pytest.fixture(scope="module")
def every_part(tmp_path_factory):
    template = tmp_path_factory.mktemp("page") / "every_part.html"
    template.write_text(EVERY_PART)

    def shown(words):
        table = page.Table([words, words], [[words, words]], words)
        return page.render(template, title=words, words=words, table=table)

    return shown


@settings(max_examples=8)
@example("<p>&amp;\"'{{ words }}</p>")
@given(words=st.text(st.characters(codec="utf-8", exclude_characters="\r\0"), min_size=1))
def test_all_words_are_shown_as_they_are_written(every_part, words):
    # title and heading, paragraph, table 5, picture 1, pair 3, legend 1, facts 2
    assert read(every_part(words)).count(words) >= 15


def test_a_page_needs_nothing_from_elsewhere_and_lets_only_its_own_script_run(every_part):
    text = every_part("words")
    assert not re.search(r"https?:|url\(|@import|<link", text)
    assert "prefers-color-scheme: dark" in text
    assert 'name="viewport"' in text
    (script,) = re.findall("<script>(.*)</script>", text, re.DOTALL)
    assert page.allowed(script) in text


def test_a_template_that_misses_a_value_fails(tmp_path):
    (tmp_path / "a.html").write_text("{{ absent }}")
    with pytest.raises(UndefinedError, match="absent"):
        page.render(tmp_path / "a.html", title="t")


def test_columns_of_words_are_told_from_numbers(tmp_path):
    (tmp_path / "a.html").write_text('{% import "parts.html" as parts %}{{ parts.table(table) }}')
    table = page.Table(["a", "b", "c"], [["x", "y", "1"]], words=2)
    text = page.render(tmp_path / "a.html", table=table)
    assert text.count('class="words"') == 3  # two in the head, one beside the row's name


def test_a_map_has_one_pixel_for_each_value_and_the_legends_colours(tmp_path):
    values = torch.tensor([[0.0, 5.0, 10.0], [20.0, 2.5, 7.5]])
    save_map(tmp_path / "map.png", values, 10.0)
    with Image.open(tmp_path / "map.png") as picture:
        assert picture.size == (3, 2)
        colours = picture.convert("RGB")
    stops = colour_stops(5)
    at = {(0, 0): 0, (1, 0): 2, (2, 0): 4, (0, 1): 4, (1, 1): 1, (2, 1): 3}
    for place, stop in at.items():
        expected = tuple(int(stops[stop][k : k + 2], 16) for k in (1, 3, 5))
        assert colours.getpixel(place) == pytest.approx(expected, abs=3)
