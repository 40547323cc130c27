"""Columns of a PLY, whatever stands around them."""

import io

import numpy as np
import pytest

from fragprune_plugins.files.ply_table import header_lines, read_vertices
from fragprune_plugins.files.reading import Reading

ROWS = np.array([[1, 2], [3, 4], [5, 6]], dtype=np.float64)


def table(path, kind, body, *before, properties=("double x", "double y")):
    lines = [b"ply", b"format " + kind + b" 1.0", *before, b"element vertex 3"]
    lines += [b"property " + each.encode() for each in properties]
    path.write_bytes(b"\n".join([*lines, b"end_header\n"]) + body)
    with open(path, "rb") as file:
        reading = Reading(path, file, path.stat().st_size)
        try:
            return read_vertices(reading), reading
        except Exception as error:
            error.place = reading.place
            raise


def binary(rows, order="<"):
    return rows.astype(order + "f8").tobytes()


BEFORE = [b"element extra 2", b"property uchar a", b"property short b", b"property float c"]


@pytest.mark.parametrize(
    ("kind", "body", "before"),
    [
        (b"binary_little_endian", b"z" * 14 + binary(ROWS, "<"), BEFORE),
        (b"binary_big_endian", b"z" * 14 + binary(ROWS, ">"), BEFORE),
        (b"ascii", b"9 9 9 9 9 9\n1 2\n3 4\n5 6\n", BEFORE),
        (b"ascii", b"1 2 3 4 5 6", []),  # text may end with its last digit
    ],
)
def test_elements_before_are_skipped_by_their_size(tmp_path, kind, body, before):
    columns, reading = table(tmp_path / "a", kind, body, *before)
    assert list(columns) == ["x", "y"]
    assert np.array_equal(np.stack(list(columns.values()), axis=1), ROWS)
    assert columns["x"].dtype.newbyteorder("=") == np.float64
    assert reading.place == ""


@pytest.mark.parametrize(
    ("kind", "body", "said"),
    [
        (b"ascii", b"9 9 9 9 9 9 1.25 2.25 3.25\n", "cut off in row 1 of 3"),
        (b"ascii", b"1 2 3", "3 rows announced, in 5 bytes of text"),
        (b"binary_little_endian", b"z" * 6 + binary(ROWS[:1]), "cut off in row 1 of 3, 16 bytes"),
    ],
)
def test_a_table_that_is_cut_off_says_in_which_row(tmp_path, kind, body, said):
    before = [b"element extra 3", b"property uchar a", b"property uchar b"]
    with pytest.raises(EOFError, match=said):
        table(tmp_path / "a", kind, body, *before)


@pytest.mark.parametrize("line", [b"comment \xff \x00", b"obj_info made by hand", b"", b"comment"])
def test_lines_for_people_are_passed_over(tmp_path, line):
    columns, _ = table(tmp_path / "a", b"binary_little_endian", binary(ROWS), line)
    assert columns["y"].tolist() == [2, 4, 6]


@pytest.mark.parametrize(
    ("lines", "place"),
    [
        ([b"element extra 1", b"property uchar a", b"property uchar a"], 5),
        ([b"element extra 1", b"property list uchar int a", b"property list uchar int a"], 5),
        ([b"element extra 1", b"property list uchar int a", b"property uchar a"], 5),
        ([b"property uchar a"], 3),
        ([b"property list uchar int a"], 3),
        ([b"element extra -1"], 3),
        ([b"element extra 1000000000000000000000"], 3),
        ([b"element extra 1", b"property colour a"], 4),
        ([b"format ascii 2.0"], 3),
        ([b"format text 1.0"], 3),
        ([b"OBJ_INFO"], 3),
    ],
)
def test_a_header_line_that_means_nothing_is_named(tmp_path, lines, place):
    with pytest.raises(ValueError, match=lines[-1].decode()[:80]) as caught:
        table(tmp_path / "a", b"binary_little_endian", binary(ROWS), *lines)
    assert caught.value.place == f"line {place} of the header"


def test_columns_of_two_elements_may_have_one_name(tmp_path):
    before = [b"element extra 1", b"property uchar x"]
    columns, _ = table(tmp_path / "a", b"binary_little_endian", b"z" + binary(ROWS), *before)
    assert columns["x"].tolist() == [1, 3, 5]


@pytest.mark.parametrize(
    ("properties", "said"),
    [(["list uchar int x"], r"element vertex has lists \(x\)"), ([], "element vertex has no col")],
)
@pytest.mark.parametrize("kind", [b"ascii", b"binary_little_endian"])
def test_an_element_that_is_no_table_is_refused(tmp_path, properties, said, kind):
    with pytest.raises(ValueError, match=said):
        table(tmp_path / "a", kind, binary(ROWS), properties=properties)


def test_a_file_without_vertices_or_without_a_format_is_refused(tmp_path):
    with pytest.raises(KeyError, match="vertex"):
        read_vertices(Reading(tmp_path, io.BytesIO(b"ply\nformat ascii 1.0\nend_header\n"), 32))
    with pytest.raises(ValueError, match="no format"):
        read_vertices(Reading(tmp_path, io.BytesIO(b"ply\nelement vertex 1\nend_header\n"), 32))


@pytest.mark.parametrize("end", [b"\n", b"\r\n", b"\r"])
def test_a_header_ends_where_its_last_line_does(end):
    lines, size = header_lines(end.join([b"ply", b"comment a", b"end_header", b"1 2"]))
    assert lines == [b"ply", b"comment a"]
    assert size == len(end.join([b"ply", b"comment a", b"end_header", b""]))


@pytest.mark.parametrize("head", [b"", b"ply", b"plyx\nend_header\n", b"PLY\nend_header\n", b"p\n"])
def test_what_does_not_begin_as_a_ply_is_refused(head):
    with pytest.raises(ValueError, match="does not begin with 'ply'"):
        header_lines(head)
    with pytest.raises(ValueError, match="no end_header in the first 7 bytes"):
        header_lines(b"ply\na b")
