"""Makes one host's miniature from another's source by replacing passages and adding methods."""

from __future__ import annotations

import ast
import inspect
import textwrap
from collections.abc import Collection, Mapping, Sequence
from pathlib import Path

Changes = Sequence[tuple[str, str]]
"""Passages and what replaces them; each must be there once."""


def changed(text: str, changes: Changes) -> str:
    """Replace each passage in a text; ValueError if one does not occur exactly once."""
    for old, new in changes:
        if (count := text.count(old)) != 1:
            raise ValueError(f"{count} times in the text, expected once: {old!r}")
        text = text.replace(old, new)
    return text


def rewrite(root: Path, changes: Mapping[str, Changes], added: type | None = None) -> None:
    """Change files of a host, and give its model the methods of a class.

    Args:
        changes: passages to replace, by file relative to the folder.
        added: a class; the source of its methods is added to GaussianModel. They replace methods of
            the same names, which they can call as ``vanilla_NAME``, without underscores around it.
    """
    for name, passages in changes.items():
        file = root / name
        file.write_text(changed(file.read_text(encoding="utf-8"), passages), encoding="utf-8")
    if added is not None:
        model = root / "scene" / "gaussian_model.py"
        text = _renamed(model.read_text(encoding="utf-8"), vars(added))
        model.write_text(f"{text}\n{_body(added)}", encoding="utf-8")


def without(text: str, names: Collection[str]) -> str:
    """A module's text without the functions, or methods, of these names."""
    lines, gone = text.splitlines(keepends=True), set()
    for node in ast.walk(ast.parse(text)):
        if isinstance(node, ast.FunctionDef) and node.name in names:
            gone |= set(range(_first_line(node), (node.end_lineno or 0) + 1))
    return "".join(line for number, line in enumerate(lines, 1) if number not in gone)


def _renamed(text: str, names: Collection[str]) -> str:
    """A module's text with other names for the functions, or methods, of these names."""
    lines = text.splitlines(keepends=True)
    for node in ast.walk(ast.parse(text)):
        if isinstance(node, ast.FunctionDef) and node.name in names:
            line, new = lines[node.lineno - 1], f"vanilla_{node.name.strip('_')}"
            lines[node.lineno - 1] = line.replace(f"def {node.name}(", f"def {new}(", 1)
    return "".join(lines)


def _body(kind: type) -> str:
    """The source of a class's methods, without its docstring."""
    source = textwrap.dedent(inspect.getsource(kind))
    (definition,) = ast.parse(source).body
    assert isinstance(definition, ast.ClassDef)
    first = next(node for node in definition.body if isinstance(node, ast.FunctionDef))
    return "".join(source.splitlines(keepends=True)[_first_line(first) - 1 :])


def _first_line(function: ast.FunctionDef) -> int:
    """Of its decorators, if it has some."""
    return min([function.lineno, *(each.lineno for each in function.decorator_list)])
