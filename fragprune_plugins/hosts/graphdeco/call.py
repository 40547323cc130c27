"""Reads the rasterizer calls of a host's drawing functions from their source."""

from __future__ import annotations

import ast
from collections.abc import Iterator
from dataclasses import dataclass, replace

from fragprune_plugins.hosts.source import Function, HostRepo

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
        passed = replace(found, arguments=self.arguments)
        return found.arguments <= self.arguments and passed == self

    def __str__(self) -> str:
        passed = f"{', '.join(sorted(self.besides))} besides the shared settings"
        given = f"{', '.join(sorted(self.arguments))} besides the shared arguments"
        parts = [
            passed if self.besides else "the shared settings alone",
            *([given] if self.arguments else []),
            "the result kept whole" if self.outputs is None else f"{self.outputs} values back",
            *([f"from {self.package}"] if self.package else []),
        ]
        return ", ".join(parts)


@dataclass(frozen=True)
class CallInSource:
    """A rasterizer call, with its place in the source.

    Attributes:
        call: the call, with its package filled in.
        settings: names passed by keyword, in order.
        line: where its result is assigned.
    """

    call: RasterizerCall
    settings: tuple[str, ...]
    line: int


def drawing_functions(repo: HostRepo, module: str) -> list[str]:
    """Functions and methods of a module that make settings for a rasterizer, in source order."""
    tree = repo.tree(module)
    scopes = [("", node) for node in (tree.body if tree else ())]
    scopes += [
        (f"{k.name}.", node) for _, k in scopes if isinstance(k, ast.ClassDef) for node in k.body
    ]
    return [
        f"{within}{node.name}"
        for within, node in scopes
        if isinstance(node, ast.FunctionDef)
        and any(_calls(inner, SETTINGS) for inner in ast.walk(node))
    ]


def read_calls(repo: HostRepo, module: str, function: str) -> list[CallInSource]:
    """How a function calls the rasterizer, once for each place that does.

    Empty if the function is absent or passes no settings by keyword.
    """
    body = repo.function(module, function)
    made = (node for node in (ast.walk(body) if body else ()) if isinstance(node, ast.Call))
    settings = [node.keywords for node in made if _calls(node, SETTINGS)]
    names = tuple(k.arg for k in settings[0] if k.arg) if settings else ()
    if body is None or not names:
        return []
    besides, package = frozenset(names) - set(SHARED), _package(repo, module, body)
    drawn = sorted(_drawn(body), key=lambda each: each[1])
    return [
        CallInSource(RasterizerCall(besides, outputs, function, given, package), names, line)
        for outputs, line, given in drawn or [(None, body.lineno, frozenset())]
    ]


def _drawn(body: Function) -> Iterator[tuple[int | None, int, frozenset[str]]]:
    """Values unpacked, line and further arguments of every call of the rasterizer."""
    assigned = [node for node in ast.walk(body) if isinstance(node, ast.Assign)]
    targets = {id(node.value): node.targets[0] for node in assigned}
    rasterizers = {
        node.targets[0].id
        for node in assigned
        if _calls(node.value, RASTERIZER) and isinstance(node.targets[0], ast.Name)
    }
    for node in (each for each in ast.walk(body) if isinstance(each, ast.Call)):
        called = node.func
        if isinstance(called, ast.Attribute) and called.attr != "markVisible":
            called = called.value  # another method that draws
        if _calls(called, RASTERIZER) or getattr(called, "id", None) in rasterizers:
            target = targets.get(id(node), node)
            outputs = len(target.elts) if isinstance(target, ast.Tuple) else None
            given = frozenset(k.arg for k in node.keywords if k.arg) - set(ARGUMENTS)
            yield outputs, target.lineno, given


def _package(repo: HostRepo, module: str, body: Function) -> str:
    """The package of the function's rasterizer, by the function's imports, then the module's."""
    for scope in (body, repo.tree(module)):
        for node in ast.walk(scope) if scope else ():
            if isinstance(node, ast.ImportFrom) and any(RASTERIZER in a.name for a in node.names):
                return repo.absolute(module, node)
    return "an unknown package"


def _calls(node: ast.AST, name: str) -> bool:
    """Whether a node calls a class of this name, or of one that a fork made of it."""
    return isinstance(node, ast.Call) and isinstance(node.func, ast.Name) and name in node.func.id
