"""Reads the rasterizer calls of a host's drawing functions from their source."""

from __future__ import annotations

import ast
import re
from collections.abc import Mapping
from dataclasses import dataclass, field
from functools import lru_cache
from typing import Any

from fragprune_graphdeco.syntax import assigned, every, text_of
from fragprune_plugins.adapting import Function, HostRepo, nodes

SETTINGS, RASTERIZER = "GaussianRasterizationSettings", "GaussianRasterizer"

SHARED = (
    *("image_height", "image_width", "tanfovx", "tanfovy", "bg", "scale_modifier"),
    *("viewmatrix", "projmatrix", "sh_degree", "campos", "prefiltered", "debug"),
)
"""Settings that every rasterizer of these hosts takes."""

ARGUMENTS = (
    *("means3D", "means2D", "opacities", "shs", "colors_precomp"),
    *("scales", "rotations", "cov3D_precomp"),
)
"""Arguments of the call that every one of them takes."""


@dataclass(frozen=True)
class RasterizerCall:
    """The arguments and outputs of a drawing function's rasterizer call.

    Attributes:
        besides: settings in addition to the shared ones.
        outputs: number of returned values; None if the host does not unpack the tuple.
        function: the function that makes the call; "" for that of the first VIEW seam.
        arguments: allowed arguments in addition to the shared ones.
        package: import name of the rasterizer; "" for the adapter's.
    """

    besides: frozenset[str] = frozenset()
    outputs: int | None = 2
    function: str = ""
    arguments: frozenset[str] = frozenset()
    package: str = ""

    def answers(self, found: RasterizerCall) -> bool:
        """Whether a dialect for this call can answer the call found in a source."""
        ours, theirs = (
            (each.besides, each.outputs, each.function, each.package) for each in (self, found)
        )
        return ours == theirs and found.arguments <= self.arguments

    def __str__(self) -> str:
        more = ", ".join(sorted(self.besides | self.arguments))
        takes = f"also takes {more}" if more else "takes what hosts share"
        gives = "its result kept whole" if self.outputs is None else f"gives {self.outputs} values"
        package = f" of {self.package}" if self.package else ""
        return f"the rasterizer{package} {takes}, {gives}"


@dataclass(frozen=True)
class CallInSource(RasterizerCall):
    """A rasterizer call, with its place in the source and its package filled in."""

    settings: tuple[str, ...] = ()  # names, in order
    line: int = 0  # where its result is assigned
    names: tuple[str, ...] = ()  # of the values; "" for no plain name, () if they were not read
    given: Mapping[str, ast.expr] = field(default_factory=dict, compare=False)  # by name

    @property
    def other_matrix(self) -> str:
        """What it passes as the projection, if that is called by another name; "" if not."""
        matrix = self.given.get("projmatrix")
        text = text_of(matrix) if isinstance(matrix, ast.Attribute) else ""
        return "" if re.search("proj|full|mvp", text) else text

    def __str__(self) -> str:
        projects = f", projmatrix is {self.other_matrix}" if self.other_matrix else ""
        return f"{super().__str__()}{projects}"


def drawing_functions(repo: HostRepo, module: str) -> list[str]:
    """Functions and methods of a module that make settings for a rasterizer, in source order."""
    scopes = [("", node) for node in getattr(repo.tree(module), "body", ())]
    scopes += [
        (f"{k.name}.", node) for _, k in scopes if isinstance(k, ast.ClassDef) for node in k.body
    ]
    made = [(f"{of}{n.name}", n) for of, n in scopes if isinstance(n, ast.FunctionDef)]
    read = ((name, nodes(n), _Imported(repo, module, n)) for name, n in made)
    return [name for name, parts, of in read if any(of.of(each, SETTINGS) for each in parts)]


@lru_cache(maxsize=64)  # of the adapters, many ask
def read_calls(repo: HostRepo, module: str, function: str) -> tuple[CallInSource, ...]:
    """How a function calls the rasterizer, once for each place; empty without any, or settings."""
    body = repo.function(module, function)
    if body is None:
        return ()
    imported = _Imported(repo, module, body)
    made = [node for node in every(body, ast.Call) if imported.of(node, SETTINGS)]
    settings = _settings(made[0]) if made else {}
    if not settings:
        return ()

    def call(
        maker: ast.Call, place: ast.expr | Function, given: dict[str, ast.expr] | None = None
    ) -> CallInSource:
        unpacked = tuple(getattr(each, "id", "") for each in getattr(place, "elts", ()))
        return CallInSource(
            besides=frozenset(settings) - set(SHARED),
            outputs=len(unpacked) or None,
            function=function,
            arguments=frozenset(given or ()) - set(ARGUMENTS),
            package=imported.called(maker)[0],
            settings=tuple(settings),
            line=place.lineno,
            names=unpacked or _taken(body, getattr(place, "id", "")),
            given=(given or {}) | settings,
        )

    targets = {value: target for target, value in assigned(body)}
    named = ((to, value) for value, to in targets.items() if isinstance(to, ast.Name))
    rasterizers = {to.id: value for to, value in named if imported.of(value, RASTERIZER)}
    found = []
    for node in every(body, ast.Call):
        called = node.func
        if isinstance(called, ast.Attribute) and called.attr != "markVisible":
            called = called.value  # another method that draws
        own = imported.of(called, RASTERIZER)
        if own or getattr(called, "id", None) in rasterizers:
            maker: ast.Call = called if own else rasterizers[called.id]  # type: ignore[attr-defined, assignment]
            keywords = [each for each in maker.keywords if each.arg != "raster_settings"]
            given = {each.arg: each.value for each in [*keywords, *node.keywords] if each.arg}
            found.append(call(maker, targets.get(node, node), given))
    return tuple(sorted(found, key=lambda each: each.line)) or (call(made[0], body),)


def _settings(made: ast.Call) -> dict[str, ast.expr]:
    """The settings of a call by name: positions are those of the 3DGS rasterizer."""
    unnamed = [SHARED[i] if i < len(SHARED) else f"number {i + 1}" for i in range(len(made.args))]
    named = {each.arg: each.value for each in made.keywords if each.arg}
    return dict(zip(unnamed, made.args, strict=True)) | named


def _taken(body: Function, whole: str) -> tuple[str, ...]:
    """Names that a function gives the values of a result, which it keeps under a name first.

    Of several lengths that it asks for the greatest; () if it does anything else with the result.
    """
    taken, known = dict[int, set[str]](), 0
    for node in every(body, ast.Assign):
        target = node.targets[0]
        if whole and getattr(node.value, "id", "") == whole:
            names = [getattr(each, "id", "") for each in getattr(target, "elts", ())]
            known += bool(names)
            for number, name in enumerate(names):
                taken.setdefault(number, set()).add(name)
        for each in every(node.value, ast.Subscript):
            index = getattr(each.slice, "value", None)
            if type(index) is int and text_of(each.value) == whole:
                taken.setdefault(index, set()).add(getattr(target, "id", ""))
                known += 1
    lengths = sum(text_of(each) == f"len({whole})" for each in nodes(body))
    reads = [each for each in every(body, ast.Name) if each.id == whole]
    stored = sum(isinstance(each.ctx, ast.Store) for each in reads)
    if known + lengths + stored != len(reads) or any(len(each) > 1 for each in taken.values()):
        return ()
    numbers = range(max(taken, default=-1) + 1)
    return tuple("".join(taken.get(number, ())) for number in numbers)


class _Imported:
    """Classes of rasterizers, by the names that a function has for them.

    An import inside the function goes before one of its module.
    """

    def __init__(self, repo: HostRepo, module: str, body: Function) -> None:
        self.classes: dict[str, tuple[str, str]] = {}
        self.modules: dict[str, str] = {}
        for scope in (repo.tree(module), body):
            statements: tuple[Any, ...] = every(scope, ast.Import, ast.ImportFrom)
            for node in statements:
                if isinstance(node, ast.ImportFrom):
                    package = repo.absolute(module, node)
                    for each in node.names:
                        self.classes[each.asname or each.name] = package, each.name
                else:
                    self.modules |= {each.asname or each.name: each.name for each in node.names}

    def of(self, node: ast.AST | None, name: str) -> bool:
        """Whether a node calls a class of this name, or of one that a fork made of it."""
        return name in self.called(node)[1]

    def called(self, node: ast.AST | None) -> tuple[str, str]:
        """The package and the name of the class that a node calls."""
        function = node.func if isinstance(node, ast.Call) else None
        if isinstance(function, ast.Name):
            return self.classes.get(function.id, ("an unknown package", function.id))
        if isinstance(function, ast.Attribute) and isinstance(function.value, ast.Name):
            module = self.modules.get(function.value.id)
            return (module, function.attr) if module else ("", "")
        return "", ""
