"""Entry points of one object each: commands, formats, logs, viewers' bridges. Ours are among them.

A package offers an object in its ``pyproject.toml``, and it is imported on use.
"""

from __future__ import annotations

import contextlib
from collections.abc import Iterator
from functools import cache
from importlib.metadata import EntryPoint, entry_points
from typing import Any

from fragprune_plugins.errors import FragpruneError, PluginError, log, printable


def _owner(point: EntryPoint) -> str:
    return point.dist.name.replace("_", "-") if point.dist else point.value


@cache
def offered(group: str) -> dict[str, EntryPoint]:
    """The entry points of a group by name, sorted, such as of "fragprune.commands".

    Of two with one name ours is taken, else the first that is found; a warning names the other.
    """
    points: dict[str, EntryPoint] = {}
    found = entry_points(group=group)
    for point in sorted(found, key=lambda each: _owner(each) != "fragprune-plugins"):
        taken = points.setdefault(point.name, point)
        if point.value != taken.value:
            said = "%s %s of %s is left out: %s has one of this name. Rename or uninstall it."
            log.warning(said, group, point.name, _owner(point), _owner(taken))
    return dict(sorted(points.items()))


def load(point: EntryPoint, kind: type | tuple[type, ...] = object) -> Any:
    """Import what an entry point of ``offered`` names, which must be of a ``kind``."""
    with blaming(point):
        loaded = point.load()
        if not isinstance(loaded, kind):
            raise TypeError(f"{point.value} is a {type(loaded).__name__}")
    return loaded


CODE = (
    *(AttributeError, NameError, ImportError, TypeError, AssertionError, NotImplementedError),
    SystemExit,
)
"""What faults of code raise, and a file that is read hardly does."""


@contextlib.contextmanager
def blaming(
    point: EntryPoint,
    *passing: type[Exception],
    faults: tuple[type[BaseException], ...] = (Exception, SystemExit),
) -> Iterator[None]:
    """State what code of an entry point raises, and whose it is.

    Errors of ours pass, those in ``passing``, and what is none of ``faults``.
    """
    ours: tuple[type[Exception], ...] = (FragpruneError, *passing)
    try:
        yield
    except ours:
        raise
    except faults as error:
        owner = _owner(point)
        found = printable(f"{type(error).__name__}: {error}".split("\n", 1)[0])
        expected = f"an object that {owner} offers"
        remedy = f"Update or uninstall {owner}."
        raise PluginError(f"{point.group} {point.name}", found, expected, remedy) from error
