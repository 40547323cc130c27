"""Reads a host's source without importing it: its functions, calls and seams."""

from __future__ import annotations

import ast
import os
import re
import warnings
from contextlib import suppress
from functools import cache, cached_property, lru_cache
from importlib.metadata import distributions
from importlib.util import find_spec
from pathlib import Path

from fragprune_plugins.errors import UnknownHostError
from fragprune_plugins.files.reading import MEBIBYTE, UntrustedFile, lies_in
from fragprune_plugins.hosts.findings import Finding, SeamState
from fragprune_plugins.hosts.seams import Seam

Function = ast.FunctionDef | ast.AsyncFunctionDef

_FILE = UntrustedFile(
    UnknownHostError,
    "no source",
    "a file of a host's source",
    "Look at the file, or at the folder's permissions.",
    limit=8 * MEBIBYTE,
)


def _definition(scope: ast.AST | None, name: str) -> ast.AST | None:
    """The class or function with a name, directly inside a module or class."""
    named = [e for e in getattr(scope, "body", ()) if isinstance(e, ast.ClassDef | Function)]
    own = [e for e in named if not any("setter" in ast.dump(d) for d in e.decorator_list)]
    return next((e for e in reversed(own) if e.name == name), None)  # Python keeps the last


_COMMIT = re.compile(r"[0-9a-f]{4,64}")
_REFERENCE = re.compile(r"ref: (refs/(?!.*\.\.)[\w./+@-]+)")


@lru_cache(maxsize=256)
def parsed(text: str) -> ast.Module | None:
    """The syntax tree of a text, cached and never changed; None if it is not Python."""
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # a host's invalid escapes are its own affair
            return ast.parse(text)
    except (SyntaxError, ValueError, RecursionError, MemoryError):  # too deep, or a NUL in it
        return None


@lru_cache(maxsize=4096)
def nodes(tree: ast.AST | None) -> tuple[ast.AST, ...]:
    """Every node of a tree from ``parsed``, or of a part of it, cached; none of None."""
    return tuple(ast.walk(tree)) if tree is not None else ()


def imported(tree: ast.Module | None) -> list[str]:
    """Top-level packages that a module imports anywhere, each once."""
    names: dict[str, None] = {}
    for node in nodes(tree):
        if isinstance(node, ast.Import):
            names |= {each.name.split(".")[0]: None for each in node.names}
        elif isinstance(node, ast.ImportFrom) and node.module and not node.level:
            names[node.module.split(".")[0]] = None
    return list(names)


@cache
def _distributions(package: str, folder: Path) -> str:
    """The distributions in a folder that provide an import name, with versions."""
    found = set()
    for each in distributions(path=[str(folder)]):
        declared = (each.read_text("top_level.txt") or "").split()
        names = declared or {file.parts[0] for file in each.files or ()}
        if package in names:
            found.add(f"{each.name} {each.version}")
    return ", ".join(sorted(found))


class HostRepo:
    """A host's checkout or installed package, read as text.

    Files of a checkout are read only inside of it: a link that leads out counts as no file.

    Args:
        root: the folder of its entry scripts, or the folder that contains its package.
        package: import name of the installed package; "" for a checkout.
    """

    def __init__(self, root: Path, package: str = "") -> None:
        self.root, self.package = Path(root).resolve(), package
        self._trees: dict[str, ast.Module | None] = {}
        self._paths: dict[str, Path | None] = {}

    @classmethod
    def installed(cls, package: str) -> HostRepo | None:
        """The package that an import of this top-level name would find; None without one."""
        spec = find_spec(package) if package.isidentifier() else None
        folders = spec.submodule_search_locations if spec else None
        return cls(Path(next(iter(folders))).parent, package) if folders else None

    def path(self, module: str) -> Path | None:
        """The file a dotted module name would be imported from, or None; looked for once."""
        if module not in self._paths:
            base = self.root.joinpath(*module.split("."))
            both = (base / "__init__.py", base.with_suffix(".py"))
            found = (each for each in both if os.path.isfile(each) and self._inside(each))
            self._paths[module] = next(found, None)  # also for too long a name
        return self._paths[module]

    def _inside(self, path: Path) -> bool:
        """Whether a path stays in its checkout. Package managers install packages as links."""
        return bool(self.package) or lies_in(path, self.root)

    def read(self, path: Path) -> str:
        """The text of a file, without a mark of its encoding; "" where it is missing or outside."""
        with suppress(UnknownHostError):
            if self._inside(path):
                with _FILE.reading(path) as reading:
                    return reading.file.read().decode("utf-8", "replace").removeprefix("\ufeff")
        return ""

    def tree(self, module: str) -> ast.Module | None:
        """The module's syntax tree, or None when it is absent or not Python."""
        if module not in self._trees:
            path = self.path(module)
            self._trees[module] = parsed(self.read(path)) if path else None
        return self._trees[module]

    def definition(self, module: str, attribute: str) -> ast.AST | None:
        """The class or function at a dotted path inside a module, or None."""
        node: ast.AST | None = self.tree(module)
        for name in attribute.split("."):
            node = _definition(node, name)
        return node

    def function(self, module: str, attribute: str) -> Function | None:
        """The function at a dotted path inside a module, or None."""
        node = self.definition(module, attribute)
        return node if isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef) else None

    def place(self, module: str, attribute: str) -> str:
        """The file:line of a definition, or of the existing part of its path if it is absent."""
        names = attribute.split(".")
        parts = (self.definition(module, ".".join(names[:end])) for end in range(1, len(names) + 1))
        return self.at(module, max(getattr(part, "lineno", 1) for part in parts))

    def at(self, module: str, line: int) -> str:
        """A line of a module as file:line, the file relative to the checkout."""
        path = self.path(module)
        if path is None:
            return f"no file {module.replace('.', '/')}.py"
        return f"{path.relative_to(self.root)}:{line}"

    def parameters(self, module: str, attribute: str) -> tuple[str, ...] | None:
        """Parameter names of a function, ``self`` left out; None when it is not there."""
        function = self.function(module, attribute)
        if function is None:
            return None
        args = function.args
        names = [a.arg for a in (*args.posonlyargs, *args.args, *args.kwonlyargs)]
        return tuple(n for n in names if n != "self")

    def calls(self, module: str, name: str) -> list[ast.Call]:
        """Every call of a bare name in a module, in source order."""
        made = (node for node in nodes(self.tree(module)) if isinstance(node, ast.Call))
        return [each for each in made if getattr(each.func, "id", "") == name]

    def absolute(self, module: str, node: ast.ImportFrom) -> str:
        """The absolute dotted name of a ``from ... import`` in a module."""
        if not node.level:
            return node.module or ""
        path = self.path(module)
        up = node.level - (path is not None and path.name == "__init__.py")
        parts = module.split(".")
        return ".".join([*parts[: len(parts) - up], *([node.module] if node.module else [])])

    def imported_by(self, module: str, node: ast.Import | ast.ImportFrom) -> list[str]:
        """Dotted names that a statement may import; what it takes from a module may be one, too."""
        if isinstance(node, ast.Import):
            return [alias.name for alias in node.names]
        base = self.absolute(module, node)
        return [base, *(f"{base}.{alias.name}" for alias in node.names)]

    @cached_property
    def imported(self) -> set[str]:
        """Top-level packages that scripts right in the folder import."""
        scripts = self.root.glob("*.py")
        return {name for each in scripts for name in imported(self.tree(each.stem))}

    @cached_property
    def commit(self) -> str:
        """The checkout's commit, read from .git, or "".

        An installed package has the distributions in its folder and their versions instead.
        """
        if self.package:
            return _distributions(self.package, self.root)
        git = self.root / ".git"
        head = self.read(git / "HEAD").strip()
        reference = _REFERENCE.fullmatch(head)
        if reference is None:
            return head if _COMMIT.fullmatch(head) else ""
        found = [self.read(git / reference[1]).strip()]
        for line in self.read(git / "packed-refs").splitlines():
            commit, _, name = line.partition(" ")
            found += [commit] if name == reference[1] else []
        return next((each for each in found if _COMMIT.fullmatch(each)), "")


def look_up(repo: HostRepo, seam: Seam) -> SeamState:
    """Look up a seam in the source, without an import."""
    if seam.external:
        return SeamState(seam, "at import")
    at = repo.place(seam.module, seam.attribute)
    have = repo.parameters(seam.module, seam.attribute)
    where = f"{seam} ({at})"
    if have is None:
        broken = repo.path(seam.module) is not None and repo.tree(seam.module) is None
        found = "source that is no Python" if broken else f"no {seam.attribute}"
        gone = Finding.error("seam-missing", where, found, "one")
        return SeamState(seam, "missing", at, gone)
    missing = [name for name in seam.needs if name not in have]
    if not missing:
        return SeamState(seam, "found", at)
    found, expected = f"parameters ({', '.join(have)})", f"also {', '.join(missing)}"
    changed = Finding.error("seam-signature", where, found, expected)
    return SeamState(seam, "changed", at, changed)
