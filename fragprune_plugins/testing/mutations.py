"""Changes one thing in a host's source, as its authors might, for checks that must notice."""

from __future__ import annotations

import ast
import shutil
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path

from fragprune_plugins.hosts.seams import Seam
from fragprune_plugins.hosts.source import HostRepo

RENAMED = "renamed_by_the_conformance_kit"


def copy_source(repo: HostRepo, target: Path, packages: Sequence[str] = ()) -> HostRepo:
    """A copy of a host's Python files; of these ``packages`` alone, if it is installed."""
    for folder in [repo.root / name for name in packages] or [repo.root]:
        for file in folder.rglob("*.py"):
            if ".git" not in file.parts:
                copied = target / file.relative_to(repo.root)
                copied.parent.mkdir(parents=True, exist_ok=True)
                shutil.copyfile(file, copied)
    return HostRepo(target, repo.package)


@contextmanager
def changing(repo: HostRepo, seam: Seam) -> Iterator[None]:
    """A context in which a seam's module may be changed; it is restored at the end."""
    path, _ = _definition(repo, seam)
    original = path.read_bytes()
    try:
        yield
    finally:
        path.write_bytes(original)


def rename_function(repo: HostRepo, seam: Seam) -> None:
    """Rename the seam's function."""
    path, function = _definition(repo, seam)
    _put(path, function.lineno, function.col_offset + len("def "), function.name)


def rename_parameter(repo: HostRepo, seam: Seam, name: str) -> None:
    """Rename one parameter of the seam's function, but not its uses in the body."""
    path, function = _definition(repo, seam)
    given = function.args
    (parameter,) = (
        each for each in (*given.posonlyargs, *given.args, *given.kwonlyargs) if each.arg == name
    )
    _put(path, parameter.lineno, parameter.col_offset, name)


def unpack_one_more(repo: HostRepo, seam: Seam) -> int | None:
    """Unpack one more value where radii are unpacked; the line of the first change, if any."""
    path, function = _definition(repo, seam)
    targets = [
        target
        for node in ast.walk(function)
        if isinstance(node, ast.Assign) and isinstance(node.value, ast.Call)
        for target in node.targets
        if isinstance(target, ast.Tuple) and "radii" in ast.unparse(target)
    ]
    for target in targets:
        _put(path, target.elts[0].lineno, target.elts[0].col_offset, "", f"{RENAMED}, ")
    return min((target.lineno for target in targets), default=None)


def _put(path: Path, number: int, start: int, old: str, new: str = RENAMED) -> None:
    """Replace what begins in a column of a line; columns of a syntax tree count bytes."""
    lines = path.read_bytes().splitlines(keepends=True)
    line = lines[number - 1]
    lines[number - 1] = line[:start] + new.encode() + line[start + len(old.encode()) :]
    path.write_bytes(b"".join(lines))


def _definition(repo: HostRepo, seam: Seam) -> tuple[Path, ast.FunctionDef | ast.AsyncFunctionDef]:
    path, function = repo.path(seam.module), repo.function(seam.module, seam.attribute)
    if path is None or function is None:
        raise AssertionError(f"{seam} is not in the source, yet the adapter says that it fits")
    return path, function
