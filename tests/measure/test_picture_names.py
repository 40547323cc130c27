"""Names of pictures: each view its own file, inside the folder, whatever the view is called."""

import pytest
from hypothesis import given
from hypothesis import strategies as st

from fragprune_plugins.workbench.figures.pictures import BESIDE, stems
from fragprune_plugins.workbench.figures.wording import nothing_drawn


@pytest.mark.parametrize(
    ("names", "wanted"),
    [
        (["view04.png", "view05.png"], ["view04", "view05"]),
        (["r_0", "r_0"], ["r_0", "r_0-2"]),
        (["train/r_0", "train_r_0"], ["train_r_0", "train_r_0-2"]),
        (["A.png", "a.png"], ["A", "a-2"]),
        (["a", "a_fragments"], ["a", "a_fragments-2"]),
        (["", ".", "..", "/"], ["view", "view-2", "view-3", "_"]),
        (["a_fragments", "a"], ["a_fragments", "a-2"]),
        (["../../x.png"], ["_.._x"]),
        (["a\n\x1b[2J\0b"], ["a___2J_b"]),
    ],
)
def test_names_of_views_become_names_of_files(names, wanted):
    assert stems(names) == wanted


@given(st.lists(st.text(max_size=400), max_size=12))
def test_every_view_has_a_file_of_its_own_in_the_folder(names):
    found = stems(names)
    assert len(found) == len(names)
    files = [each + beside for each in found for beside in ("", *BESIDE)]
    assert len({file.lower() for file in files}) == len(files)
    assert not any("/" in file or "\\" in file or file.startswith(".") for file in files)
    assert all(len(file.encode()) < 200 for file in files)


@pytest.mark.parametrize(
    ("fragments", "words"),
    [([1.0, 2.0], []), ([0.0, 2.0], ["1 of 2"]), ([0.0], ["The pictures show"]), ([], [])],
)
def test_views_that_show_nothing_are_warned_of(fragments, words):
    assert [
        each[: len(word)] for each, word in zip(nothing_drawn(fragments), words, strict=True)
    ] == words
