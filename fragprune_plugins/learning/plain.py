"""Plain values of objects: their numbers, and attributes that are set from a file."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any


def numbers_of(thing: object) -> dict[str, int | float]:
    """The attributes of an object that are numbers, by name."""
    return {name: each for name, each in vars(thing).items() if isinstance(each, int | float)}


def put(thing: object, values: Mapping[str, Any]) -> None:
    """Set attributes of an object; raises ValueError if one is of another kind than it was."""
    for name, value in values.items():
        was = vars(thing).get(name, "none")
        if isinstance(was, int):  # a count, or a bool
            fits = type(value) is type(was) and value >= 0
        else:
            fits = isinstance(value, list if isinstance(was, list) else int | float | None)
        if isinstance(was, str) or not fits:
            raise ValueError(f"{name}: {value!r:.40}")
        setattr(thing, name, value)
