"""Code as such, of syntax trees: its text, its parts, what it assigns, and what it does not do."""

from __future__ import annotations

import ast
import contextlib
import operator
from collections.abc import Callable, Iterable
from functools import lru_cache
from typing import Any, TypeVar

from fragprune_plugins.adapting import Function, nodes

Node = TypeVar("Node", bound=ast.AST)


@lru_cache(maxsize=1 << 16)
def text_of(node: ast.AST | None) -> str:
    """A part of a tree from ``parsed`` as code, cached: many ask; "" of None."""
    return ast.unparse(node) if node else ""


def every(tree: ast.AST | None, *kinds: type[Node]) -> tuple[Node, ...]:
    """Those of these kinds among ``nodes``."""
    return _every(tree, kinds)


@lru_cache(maxsize=4096)
def _every(tree: ast.AST | None, kinds: tuple[type[Node], ...]) -> tuple[Node, ...]:
    return tuple(each for each in nodes(tree) if isinstance(each, kinds))


@lru_cache(maxsize=1024)
def mentioned(tree: ast.AST | None) -> frozenset[Any]:
    """Every name, attribute, definition and parameter in a tree."""
    kinds = ("id", "attr", "name", "arg")
    return frozenset(getattr(node, kind, None) for node in nodes(tree) for kind in kinds)


def off_by_default(function: Function) -> set[str]:
    """Parameters that are None or False by default."""
    a = function.args
    named = [*a.posonlyargs, *a.args][-len(a.defaults) :] if a.defaults else []
    pairs = zip([*named, *a.kwonlyargs], [*a.defaults, *a.kw_defaults], strict=True)
    return {each.arg for each, value in pairs if is_off(value)}


def is_off(value: ast.expr | None) -> bool:
    """Whether an expression is None or False."""
    return isinstance(value, ast.Constant) and value.value in (None, False)


def assigned(tree: ast.AST | None) -> list[tuple[ast.expr, ast.expr]]:
    """What gets which value in assignments, one by one where tuples do."""
    pairs = [(each, node.value) for node in every(tree, ast.Assign) for each in node.targets]
    several = [(a, b) for a, b in pairs if isinstance(a, ast.Tuple) and isinstance(b, ast.Tuple)]
    singles = (each for a, b in several for each in zip(a.elts, b.elts, strict=False))
    return [*(each for each in pairs if each not in several), *singles]


def first_of(node: ast.AST | None) -> ast.AST | None:
    """The first part of a tuple; other code as it is."""
    return node.elts[0] if isinstance(node, ast.Tuple) and node.elts else node


def chosen(node: ast.AST) -> ast.expr | None:
    """What code takes rows of by a mask or by indices, as ``xyz[mask]`` of ``xyz``; else None."""
    if not isinstance(node, ast.Subscript):
        return None
    return None if isinstance(first_of(node.slice), ast.Slice | ast.Constant) else node.value


def entries(tree: ast.AST | None, name: str) -> list[ast.expr]:
    """What dicts have under a name."""
    dicts = every(tree, ast.Dict)
    pairs = (pair for each in dicts for pair in zip(each.keys, each.values, strict=True))
    return [value for key, value in pairs if getattr(key, "value", "") == name]


def passed(call: ast.Call, names: Iterable[str]) -> dict[str, ast.expr]:
    """The values of a call by the names of what it calls takes, in order."""
    named = {each.arg: each.value for each in call.keywords if each.arg}
    return dict(zip(names, call.args, strict=False)) | named


_COMPARED = {
    **{ast.Eq: operator.eq, ast.NotEq: operator.ne, ast.Gt: operator.gt, ast.GtE: operator.ge},
    **{ast.Lt: operator.lt, ast.LtE: operator.le, ast.Is: operator.is_, ast.IsNot: operator.is_not},
}
Known = Callable[[ast.AST], list[Any]]
"""The one value of an expression; [] if it is not known."""


def skipped(tree: ast.AST | None, known: Known) -> dict[ast.AST, ast.expr]:
    """What code does not do by the values that are known: nodes, with the test before each."""
    found: dict[ast.AST, ast.expr] = {}
    branching: tuple[Any, ...] = every(tree, ast.If, ast.IfExp)
    after = _after(tree) if branching else {}
    for node in branching:
        taken = decided(node.test, known)
        branch = None if taken is None else node.orelse if taken else node.body
        unreached = branch if isinstance(branch, list) else [branch]
        for each in (*unreached, *(after.get(node, ()) if taken else ())):
            found |= dict.fromkeys(nodes(each), node.test)
    return found


def _after(tree: ast.AST | None) -> dict[ast.AST, list[ast.stmt]]:
    """What follows each branch that ends with a return."""
    blocks = (block for node in nodes(tree) if isinstance(block := getattr(node, "body", 0), list))
    return {
        node: block[number + 1 :]
        for block in blocks
        for number, node in enumerate(block)
        if isinstance(node, ast.If) and isinstance(node.body[-1], ast.Return)
    }


def decided(test: ast.expr, known: Known) -> bool | None:
    """What a test says by the values that are known; None if it asks for anything else."""
    if isinstance(test, ast.BoolOp):
        parts = [decided(each, known) for each in test.values]
        ends = isinstance(test.op, ast.Or)
        return ends if ends in parts else None if None in parts else not ends
    if isinstance(test, ast.UnaryOp) and isinstance(test.op, ast.Not):
        inner = decided(test.operand, known)
        return None if inner is None else not inner
    sides = [test.left, *test.comparators] if isinstance(test, ast.Compare) else [test]
    values = [known(each) or constant([each]) for each in sides]
    if not all(values) or not any(map(known, sides)):
        return None
    if not isinstance(test, ast.Compare):
        return bool(values[0][0])
    compared = _COMPARED.get(type(test.ops[0]))
    with contextlib.suppress(TypeError):
        return bool(compared(values[0][0], values[1][0])) if compared and len(sides) == 2 else None
    return None


def constant(given: list[Any]) -> list[Any]:
    """The value of expressions that are one and the same constant; [] if they are not."""
    try:
        values = [ast.literal_eval(each) for each in given]
    except (ValueError, TypeError, SyntaxError):
        return []
    return values[:1] if all(repr(each) == repr(values[0]) for each in values) else []
