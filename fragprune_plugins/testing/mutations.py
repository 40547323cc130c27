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
    """A copy of a host's Python files, and nothing else of it.

    Args:
        packages: the host's packages, if its folder is that of all installed packages.
    """
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
    lines = path.read_text(encoding="utf-8").splitlines(keepends=True)
    line = lines[function.lineno - 1]
    lines[function.lineno - 1] = line.replace(f"def {function.name}", f"def {RENAMED}", 1)
    path.write_text("".join(lines), encoding="utf-8")


def rename_parameter(repo: HostRepo, seam: Seam, name: str) -> None:
    """Rename one parameter of the seam's function, but not its uses in the body."""
    path, function = _definition(repo, seam)
    given = function.args
    (parameter,) = (
        each for each in (*given.posonlyargs, *given.args, *given.kwonlyargs) if each.arg == name
    )
    lines = path.read_bytes().splitlines(keepends=True)  # columns of the syntax tree count bytes
    line, start = lines[parameter.lineno - 1], parameter.col_offset
    end = start + len(name.encode())
    lines[parameter.lineno - 1] = line[:start] + RENAMED.encode() + line[end:]
    path.write_bytes(b"".join(lines))


def unpack_one_more(repo: HostRepo, seam: Seam) -> int | None:
    """Unpack one more value from the rasterizer wherever the seam's function unpacks radii.

    Returns:
        The line of the first change; None if the function unpacks no radii.
    """
    path, function = _definition(repo, seam)
    targets = [
        target
        for node in ast.walk(function)
        if isinstance(node, ast.Assign) and isinstance(node.value, ast.Call)
        for target in node.targets
        if isinstance(target, ast.Tuple) and "radii" in ast.unparse(target)
    ]
    lines = path.read_bytes().splitlines(keepends=True)
    for target in targets:
        first, start = target.elts[0], target.elts[0].col_offset
        line = lines[first.lineno - 1]
        lines[first.lineno - 1] = line[:start] + f"{RENAMED}, ".encode() + line[start:]
    path.write_bytes(b"".join(lines))
    return min((target.lineno for target in targets), default=None)


def _definition(repo: HostRepo, seam: Seam) -> tuple[Path, ast.FunctionDef | ast.AsyncFunctionDef]:
    path, function = repo.path(seam.module), repo.function(seam.module, seam.attribute)
    if path is None or function is None:
        raise AssertionError(f"{seam} is not in the source, yet the adapter says that it fits")
    return path, function
