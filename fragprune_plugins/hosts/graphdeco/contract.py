"""What a host's drawing function passes its rasterizer and takes back, read from its source."""

from __future__ import annotations

import ast
from dataclasses import dataclass

from fragprune_plugins.hosts.source import Function, HostRepo

SETTINGS, RASTERIZER = "GaussianRasterizationSettings", "GaussianRasterizer"

SHARED = (
    *("image_height", "image_width", "tanfovx", "tanfovy", "bg", "scale_modifier"),
    *("viewmatrix", "projmatrix", "sh_degree", "campos", "prefiltered", "debug"),
)
"""Settings that every rasterizer of the lineage takes."""


@dataclass(frozen=True)
class Contract:
    """A call of the lineage's rasterizer.

    Attributes:
        besides: settings passed besides the shared ones.
        outputs: how many values come back; None where the host keeps the tuple whole.
        function: of ``gaussian_renderer`` that makes it.
    """

    besides: frozenset[str] = frozenset()
    outputs: int | None = 2
    function: str = "render"

    def __str__(self) -> str:
        passed = f"{', '.join(sorted(self.besides))} besides the shared settings"
        back = "the result kept whole" if self.outputs is None else f"{self.outputs} values back"
        return f"{passed if self.besides else 'the shared settings alone'}, {back}"


@dataclass(frozen=True)
class Call:
    """One as the source has it.

    Attributes:
        contract: what it amounts to.
        settings: names passed by keyword, in order.
        line: where its result is assigned.
    """

    contract: Contract
    settings: tuple[str, ...]
    line: int


def read_calls(repo: HostRepo, module: str, function: str) -> list[Call]:
    """How a function calls the rasterizer, once for each place that takes a result.

    Empty where the function is absent or passes no settings by keyword.
    """
    body = repo.function(module, function)
    made = (node for node in (ast.walk(body) if body else ()) if isinstance(node, ast.Call))
    settings = [node.keywords for node in made if _calls(node, SETTINGS)]
    names = tuple(k.arg for k in settings[0] if k.arg) if settings else ()
    if body is None or not names:
        return []
    besides = frozenset(names) - set(SHARED)
    counts = [
        (len(target.elts) if isinstance(target, ast.Tuple) else None, target.lineno)
        for target in _results(body)
    ]
    return [
        Call(Contract(besides, outputs, function), names, line)
        for outputs, line in counts or [(None, body.lineno)]
    ]


def _results(body: Function) -> list[ast.expr]:
    """Targets that the rasterizer's results are assigned to, in source order."""
    assigned = [node for node in ast.walk(body) if isinstance(node, ast.Assign)]
    rasterizers = {
        node.targets[0].id
        for node in assigned
        if _calls(node.value, RASTERIZER) and isinstance(node.targets[0], ast.Name)
    }
    drawn = [
        node.targets[0]
        for node in assigned
        if isinstance(node.value, ast.Call)
        and (
            _calls(node.value.func, RASTERIZER)
            or (isinstance(node.value.func, ast.Name) and node.value.func.id in rasterizers)
        )
    ]
    return sorted(drawn, key=lambda target: target.lineno)


def _calls(node: ast.AST, name: str) -> bool:
    return isinstance(node, ast.Call) and isinstance(node.func, ast.Name) and node.func.id == name
