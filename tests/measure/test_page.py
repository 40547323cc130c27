"""The frame of all pages."""

from __future__ import annotations

import re
from html.parser import HTMLParser

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from PIL import Image

from fragprune_plugins.workbench.figures import page
from fragprune_plugins.workbench.figures.pictures import colour_stops, save_map

ODD = "<b>\"&'</b>"
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


@settings(max_examples=25)
@given(st.text(st.characters(codec="utf-8", exclude_characters="\r\0"), min_size=1))
def test_all_words_are_shown_as_they_are_written(words):
    text = page.compose(
        title=words,
        quote=words,
        parts=[
            page.heading(words),
            page.paragraph(words),
            page.code(words),
            page.table([words, words], [[words, words]], words),
            page.section(words, page.picture("a.png", words, (10, 9))),
            page.section(words, page.split("a", "b", words, (10, 9), (words, words))),
            page.legend(words, 3.0),
        ],
    )
    # title and heading, quote, seven parts: 1, 1, 1, 5, 2, 4 and 1
    assert read(text).count(words) >= 18


def test_a_page_needs_nothing_from_elsewhere():
    text = page.compose(title="t", quote="q", parts=[page.legend("fragments", 10)])
    assert not re.search(r"https?:|url\(|@import|<link|src=", text)
    assert "prefers-color-scheme: dark" in text
    assert 'name="viewport"' in text


def test_nothing_is_left_of_what_is_empty():
    assert page.paragraph("") == ""
    assert "<h3>" not in page.section("", "x")


@pytest.mark.parametrize(
    ("size", "times"),
    [((90, 160), 4), ((180, 320), 2), ((160, 120), 3), ((256, 256), 1), ((800, 600), 1)],
)
def test_small_pictures_grow_by_whole_steps_and_portraits_become_no_towers(size, times):
    assert page.zoom(size) == times
    width, height = size
    assert times == 1 or (width * times <= 490 and height * times <= 640)
    shown = page.picture("a", "b", size)
    assert ("pixels" in shown) == (times > 1)
    assert f"--width:{width * times}px" in shown


def test_columns_of_words_are_told_from_numbers():
    text = page.table(["a", "b", "c"], [["x", "y", "1"]], words=2)
    assert text.count('class="words"') == 3  # two in the head, one beside the row's name
    with pytest.raises(ValueError, match="zip"):
        page.table(["a", "b"], [["x"]])


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
