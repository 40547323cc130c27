"""Entry points of one object each: commands, formats, logs, viewers' bridges. Ours are among them.

A package offers an object by a line in its ``pyproject.toml``, and it is imported on use.
"""

from __future__ import annotations

from importlib.metadata import EntryPoint, entry_points
from typing import Any

from fragprune_plugins.errors import PluginError, printable


def offered(group: str) -> dict[str, EntryPoint]:
    """The entry points of a group by name, sorted; of two with one name, the first that is found.

    Args:
        group: such as "fragprune.commands".
    """
    points: dict[str, EntryPoint] = {}
    for point in entry_points(group=group):
        points.setdefault(point.name, point)
    return dict(sorted(points.items()))


def load(point: EntryPoint, kind: type | tuple[type, ...] = object) -> Any:
    """Import what an entry point names.

    Args:
        point: of ``offered``.
        kind: what it must be an instance of.
    """
    owner = point.dist.name if point.dist else point.value
    try:
        loaded = point.load()
        if not isinstance(loaded, kind):
            raise TypeError(f"{point.value} is a {type(loaded).__name__}")
    except (Exception, SystemExit) as error:
        found = printable(f"{type(error).__name__}: {error}".split("\n", 1)[0])
        expected = f"an object that {owner} offers"
        remedy = f"Update or uninstall {owner}."
        raise PluginError(f"{point.group} {point.name}", found, expected, remedy) from error
    return loaded
