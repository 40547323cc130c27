"""Which options of a command exclude each other, and which need another: a table for each command.

A name is that of an option, as a command line spells it, or of an argument. With a value behind it,
such as "--keep auto", it stands for the option with this value; * is any text. Names that a command
does not have are never given.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from fnmatch import fnmatchcase

import click
from click.core import ParameterSource

from fragprune_plugins.errors import UsageError


@dataclass(frozen=True)
class Alone:
    """At most one of some options is given."""

    names: tuple[str, ...]
    expected: str = "one of the two"  # in an error's words

    def check(self, context: click.Context) -> None:
        """Raise UsageError if two are given."""
        found = [name for name in self.names if is_given(context, name)]
        if len(found) > 1:
            both = " with ".join(found[:2])
            raise UsageError("options", both, self.expected, "Drop one of the two.")


@dataclass(frozen=True)
class Needs:
    """An option is given only with one of others."""

    name: str
    others: tuple[str, ...]
    expected: str  # in an error's words

    def check(self, context: click.Context) -> None:
        """Raise UsageError if it is given without any of the others."""
        if is_given(context, self.name) and not any(is_given(context, o) for o in self.others):
            found = f"{self.name} without {' or '.join(self.others)}"
            remedy = f"Add {self.others[0]}, or drop {self.name}."
            raise UsageError("options", found, self.expected, remedy)


Rules = Sequence[Alone | Needs]


def apart(name: str, *others: str, expected: str) -> tuple[Alone, ...]:
    """An option that goes with none of others, which may go together."""
    return tuple(Alone((name, other), expected) for other in others)


def is_given(context: click.Context, name: str) -> bool:
    """Whether the user gave an option or argument, on the command line or in a file."""
    word, _, wanted = name.partition(" ")
    for param in context.command.params:
        if word not in (*param.opts, *param.secondary_opts, param.human_readable_name):
            continue
        value = context.params.get(str(param.name))
        if wanted:
            return fnmatchcase(str(value).lower(), wanted)
        if isinstance(param, click.Option) and param.is_flag:
            return value is (word not in param.secondary_opts)
        return context.get_parameter_source(str(param.name)) is not ParameterSource.DEFAULT
    return False
