"""Reads the vertex element of a PLY as columns: binary of both byte orders, and text."""

from __future__ import annotations

import warnings
from dataclasses import dataclass
from typing import Any

import numpy as np

from fragprune_plugins.files.reading import MEBIBYTE, Reading

HEADER_MAX = MEBIBYTE  # most bytes of a header; a splat's has some 2,000
Columns = dict[str, np.ndarray[Any, Any]]  # (N,) each, by name

_ORDERS = {"ascii": "", "binary_little_endian": "<", "binary_big_endian": ">"}
_CODES = ["i1", "u1", "i2", "u2", "i4", "u4", "f4", "f8"]
_OLD = ["char", "uchar", "short", "ushort", "int", "uint", "float", "double"]
_NEW = ["int8", "uint8", "int16", "uint16", "int32", "uint32", "float32", "float64"]
_TYPES = dict(zip(_OLD + _NEW, _CODES + _CODES, strict=True))


@dataclass
class _Element:
    """One element of a header: its rows, and a (name, type) for each column, type "" of a list."""

    name: str
    count: int
    columns: list[tuple[str, str]]

    def dtype(self, order: str) -> np.dtype[Any]:
        lists = [name for name, kind in self.columns if not kind]
        if lists:
            raise ValueError(f"element {self.name} has lists ({lists[0]})")
        if not self.columns:
            raise ValueError(f"element {self.name} has no columns")
        return np.dtype([(name, order + kind) for name, kind in self.columns])


def header_lines(head: bytes) -> tuple[list[bytes], int]:
    """The lines of a PLY's header, without ``end_header``, and the byte at which it ends."""
    end_of_line = next((end for end in (b"\r\n", b"\n", b"\r") if head[3:].startswith(end)), None)
    if not head.startswith(b"ply") or end_of_line is None:
        raise ValueError("it does not begin with 'ply'")
    mark = end_of_line + b"end_header" + end_of_line
    end = head.find(mark)
    if end < 0:
        raise ValueError(f"no end_header in the first {len(head)} bytes")
    return head[:end].split(end_of_line), end + len(mark)


def read_vertices(reading: Reading) -> Columns:
    """The columns of the element ``vertex``, as the file has them.

    Elements before it are skipped. Every announced count is compared with the file's length before
    anything is allocated.

    Raises:
        KeyError: there is no such element.
        ValueError: the file is no PLY, or not one of plain numbers.
        EOFError: the file is shorter than its header says.
    """
    return read_elements(reading, ("vertex",))["vertex"]


def read_elements(reading: Reading, wanted: tuple[str, ...]) -> dict[str, Columns]:
    """The columns of elements by name, "vertex" among them; of a PLY in text that one only."""
    lines, start = header_lines(reading.file.read(HEADER_MAX))
    order, elements = _parse(reading, lines)
    reading.place = ""
    names = [element.name for element in elements]
    if "vertex" not in names:
        raise KeyError("vertex")
    reading.file.seek(start)
    if order == "":
        *before, vertex = elements[: names.index("vertex") + 1]
        return {"vertex": _text(reading, before, vertex)}
    last = max(index for index, name in enumerate(names) if name in wanted)
    found: dict[str, Columns] = {}
    for element in elements[: last + 1]:
        if element.name in wanted and element.name not in found:
            found[element.name] = _binary(reading, element, order)
        else:
            reading.skip(element.count * element.dtype(order).itemsize)
    return found


def _binary(reading: Reading, element: _Element, order: str) -> Columns:
    """The columns of a binary element, from where the file is."""
    kind = element.dtype(order)
    if element.count * kind.itemsize > reading.left:
        row = reading.left // kind.itemsize
        raise EOFError(f"cut off in row {row} of {element.count}, {kind.itemsize} bytes each")
    rows = np.fromfile(reading.file, dtype=kind, count=element.count)
    if len(rows) != element.count:
        raise EOFError(f"cut off in row {len(rows)} of {element.count}")
    return {name: rows[name] for name, _ in element.columns}


def _text(reading: Reading, before: list[_Element], vertex: _Element) -> Columns:
    """The columns of a PLY in text, float64."""
    for element in (*before, vertex):
        element.dtype("<")  # states what is not a plain number
    skipped = sum(element.count * len(element.columns) for element in before)
    wanted = vertex.count * len(vertex.columns)
    if 2 * (skipped + wanted) > reading.left + 1:  # a digit and a space each
        raise EOFError(f"{vertex.count} rows announced, in {reading.left} bytes of text")
    with warnings.catch_warnings():
        warnings.simplefilter("error")  # numpy's word for text that is no number
        values = np.fromfile(reading.file, dtype=np.float64, count=skipped + wanted, sep=" ")
    rows = (len(values) - skipped) // len(vertex.columns)
    if rows < vertex.count:
        raise EOFError(f"cut off in row {rows} of {vertex.count}")
    table = values[skipped:].reshape(vertex.count, len(vertex.columns))
    return {name: table[:, index] for index, (name, _) in enumerate(vertex.columns)}


def _parse(reading: Reading, lines: list[bytes]) -> tuple[str, list[_Element]]:
    """The byte order ("" for text) and the elements of a header."""
    order, elements = None, list[_Element]()
    seen: set[str] = set()
    for number, line in enumerate(lines[1:], start=2):
        reading.place = f"line {number} of the header"
        words = line.decode("utf-8", "replace").split()
        match words:
            case ["comment" | "obj_info", *_] | []:
                pass
            case ["format", kind, "1.0"] if kind in _ORDERS:
                order = _ORDERS[kind]
            case ["element", name, count] if count.isdecimal() and len(count) < 19:
                elements.append(_Element(name, int(count), []))
                seen = set()
            case ["property", kind, name] if kind in _TYPES and elements and name not in seen:
                elements[-1].columns.append((name, _TYPES[kind]))
                seen.add(name)
            case ["property", "list", _, _, name] if elements and name not in seen:
                elements[-1].columns.append((name, ""))
                seen.add(name)
            case _:
                raise ValueError(f"{' '.join(words)[:80]!r}")
    if order is None:
        raise ValueError("no format that we read")
    return order, elements
