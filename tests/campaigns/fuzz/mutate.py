"""Changes a good file in ways that parsers trip over: counts, lengths, numbers, nesting."""

import random
import re
import struct
from collections.abc import Callable, Sequence

SIZE_MAX = 1 << 16
"""Inputs stay small: what takes long then does so by its nature."""

_WHOLE = (0, 1, -1, 2, 127, 255, 1 << 15, (1 << 31) - 1, 1 << 31, (1 << 32) - 1, 1 << 40, 1 << 61)
_REAL = (0.0, -0.0, 1.0, -1.0, 1e-45, 1e-30, 1e19, 3e38, float("nan"), float("inf"), -float("inf"))
_NUMBERS = (
    *("0", "-1", "1e400", "-1e400", "NaN", "nan", "inf", "Infinity", "-Infinity", "1e-320"),
    *("9223372036854775808", "18446744073709551616", "2147483648", "-2147483649", "1e19", "0x10"),
    *("9" * 400, "9" * 5000, "true", "null", '""', "[]", "{}", '"a"', "[[]]", "1_000", "\u0663"),
)
_TOKENS = (
    *(b"\0", b"\n", b"\r", b"\r\n", b'"', b"\\", b"\xff\xfe", b"\xef\xbb\xbf", b"\x80", b"/../"),
    *(b"[" * 3000, b"{" * 3000, b'{"a":' * 500, b"(" * 3000, b"-" * 3000, b"\x1b[2J"),
    *(b"property list uchar float x\n", b"property float f_rest_" + b"9" * 5000 + b"\n"),
    *(b"element vertex 9999999999\n", b"element face 3\n", b"element vertex 0\n"),
    *(b"comment " + b"x" * 9000 + b"\n", b"format ascii 1.0\n", b"end_header\n"),
    *(b"format binary_big_endian 1.0\n", b"FAKE", b"OPENCV", b"# ", b"F64", b"I64", b"F16"),
    *(b"ref: ../../../etc/passwd", b"ref: refs/../../secret", b"BOOL", b"U8", b"PK\x03\x04"),
    *(b"lambda: 0\n", b"def f():\n" * 50, b"\t" * 400, b"x" * 300, b"\xed\xa0\x80", b"%n"),
)

Change = Callable[[random.Random, bytearray], None]


def _at(dice: random.Random, data: bytearray) -> int:
    """A place; more often near the beginning, where headers are."""
    if not data:
        return 0
    return dice.randrange(min(len(data), dice.choice((16, 64, 256, len(data), len(data)))))


def _flip(dice: random.Random, data: bytearray) -> None:
    for _ in range(dice.choice((1, 1, 2, 8))):
        if data:
            data[_at(dice, data)] ^= 1 << dice.randrange(8)


def _binary_number(dice: random.Random, data: bytearray) -> None:
    """Overwrite bytes with an integer or a float that is at some end."""
    kind = dice.choice("bBhHiIqQfd")
    value = dice.choice(_REAL if kind in "fd" else _WHOLE)
    if kind not in "fd":
        bits = 8 * struct.calcsize(kind)
        value &= (1 << bits) - 1
        kind = kind.upper()
    packed = struct.pack(dice.choice("<>") + kind, value)
    begin = _at(dice, data)
    data[begin : begin + len(packed)] = packed


def _body_number(dice: random.Random, data: bytearray) -> None:
    """Overwrite one float32 of what follows the header, and leave the rest as it is."""
    whole = len(data) // 4
    if whole > 2:
        begin = len(data) - 4 * (1 + dice.randrange(max(1, 2 * whole // 3)))
        data[begin : begin + 4] = struct.pack(dice.choice("<>") + "f", dice.choice(_REAL))


def _text_number(dice: random.Random, data: bytearray) -> None:
    """Replace a number in text by another, or by what is no number."""
    found = list(re.finditer(rb"-?\d+(?:\.\d+)?(?:[eE][-+]?\d+)?", bytes(data[:20_000])))
    if found:
        begin, end = dice.choice(found).span()
        data[begin:end] = dice.choice(_NUMBERS).encode()


def _cut(dice: random.Random, data: bytearray) -> None:
    del data[dice.randrange(len(data) + 1) :]


def _remove(dice: random.Random, data: bytearray) -> None:
    begin = _at(dice, data)
    del data[begin : begin + dice.choice((1, 2, 4, 8, 24, 100))]


def _repeat(dice: random.Random, data: bytearray) -> None:
    begin = _at(dice, data)
    piece = data[begin : begin + dice.choice((1, 4, 8, 24, 100))]
    data[begin:begin] = piece * dice.choice((1, 2, 30))


def _insert(dice: random.Random, data: bytearray) -> None:
    begin = _at(dice, data)
    data[begin:begin] = dice.choice(_TOKENS)


def _word(dice: random.Random, data: bytearray) -> None:
    """Swap or remove a word: a key, a column, a name."""
    found = list(re.finditer(rb"[A-Za-z_]\w+", bytes(data[:20_000])))
    if found:
        begin, end = dice.choice(found).span()
        other = dice.choice(found).group()
        data[begin:end] = dice.choice((b"", other, other + b"x", b"x" * 300))


_CHANGES: tuple[Change, ...] = (
    *(_flip, _binary_number, _binary_number, _text_number, _text_number),
    *(_cut, _remove, _repeat, _insert, _word),
)


def mutated(dice: random.Random, pool: Sequence[bytes]) -> bytes:
    """An input: a file of the pool with one to four changes, or two files joined."""
    data = bytearray(dice.choice(pool))
    if dice.random() < 0.15:
        _body_number(dice, data)
        return bytes(data)
    if dice.random() < 0.03:
        other = dice.choice(pool)
        data = data[: dice.randrange(len(data) + 1)] + other[dice.randrange(len(other) + 1) :]
    for _ in range(dice.choice((1, 1, 1, 2, 2, 3, 4))):
        dice.choice(_CHANGES)(dice, data)
    return bytes(data[:SIZE_MAX])
