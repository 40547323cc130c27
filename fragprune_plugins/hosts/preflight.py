"""Checks before a host's script runs that its packages and its data are there."""

from __future__ import annotations

import ast
from collections.abc import Collection, Iterable, Iterator
from dataclasses import dataclass
from importlib.util import find_spec
from pathlib import Path

from fragprune_plugins.errors import HostNeedsError
from fragprune_plugins.hosts.source import HostRepo

DISTRIBUTIONS = {
    "OpenGL": "PyOpenGL",
    "PIL": "pillow",
    "cv2": "opencv-python-headless",
    "mmcv": "'mmcv<2'",  # its later releases lack what hosts import
    "skimage": "scikit-image",
    "sklearn": "scikit-learn",
    "tinycudann": "git+https://github.com/NVlabs/tiny-cuda-nn/#subdirectory=bindings/torch",
    "yaml": "pyyaml",
}
"""What pip calls a package that is imported under another name."""

# To any other name than these and those above pip may answer with something else.
_SAME_NAME = """
    einops icecream imageio joblib kornia lpips matplotlib numpy omegaconf open3d pandas plyfile
    scipy tensorboard timm torch torchmetrics torchvision tqdm transformers trimesh wandb
"""


@dataclass(frozen=True)
class Missing:
    """A package that a host imports and that is not installed."""

    module: str  # its import name
    at: str  # "file:line" of the first import found

    @property
    def distribution(self) -> str | None:
        """The package's name for pip; None if it is not known."""
        same = self.module if self.module in _SAME_NAME.split() else None
        return DISTRIBUTIONS.get(self.module, same)

    def __str__(self) -> str:
        return f"{self.module} ({self.at})"


def install(missing: Collection[Missing]) -> str:
    """How to get them: pip's command for those that it has, and where to read of others."""
    by_pip = [each.distribution for each in missing if each.distribution]
    others = [each.module for each in missing if not each.distribution]
    ways = [f"Run: pip install {' '.join(by_pip)}"] if by_pip else []
    if others:
        ways.append(f"Install as the host's own instructions say: {', '.join(others)}")
    return "\n".join(ways)


def missing_imports(
    repo: HostRepo, scripts: Iterable[Path], provided: Collection[str]
) -> list[Missing]:
    """Packages that a host's scripts import at their start and that are not installed.

    It follows imports at the top of scripts and of the host's own modules, none inside ``try``, a
    condition or a function, and leaves out dotted names for which stand-ins are ``provided``.
    """
    found: dict[str, Missing] = {}
    for script in scripts:
        for name, at in _foreign(repo, script, provided):
            if not present(name) and not _inside(repo, name):
                found.setdefault(name, Missing(name, at))
    return list(found.values())


def expect(
    repo: HostRepo, script: Path, provided: Collection[str], data: Path | None = None
) -> None:
    """Raise HostNeedsError, which lists all that is missing of a script's packages and data."""
    remedies: dict[str, str] = {}
    if missing := missing_imports(repo, [script], provided):
        remedies[f"not installed: {', '.join(map(str, missing))}"] = install(missing)
    if data is not None and not data.is_dir():
        remedies[f"no folder {data}"] = "Check the path of the data."
    if remedies:
        found, expected = "; ".join(remedies), "what the host imports and reads"
        raise HostNeedsError(script.name, found, expected, "\n".join(remedies.values()))


def _foreign(repo: HostRepo, script: Path, provided: Collection[str]) -> Iterator[tuple[str, str]]:
    """Top-level names that a script imports from outside the host, with their places."""
    inside = repo.package and script.is_relative_to(repo.root / repo.package)
    if inside:  # else a script beside the package
        begin = repo, ".".join(script.relative_to(repo.root).with_suffix("").parts)
    else:
        begin = HostRepo(script.parent), script.stem
    roots = [begin[0], repo]
    waiting, seen = [begin], set()
    while waiting:
        module = root, name = waiting.pop()
        path = root.path(name)
        if path is None or path in seen:
            continue
        seen.add(path)
        tree = root.tree(name)
        for node in _imports(tree.body if tree else [], main=module == begin):
            for wanted in root.imported_by(name, node):
                if any(wanted == each or wanted.startswith(f"{each}.") for each in provided):
                    continue
                own = list(_own(roots, wanted))
                waiting += own
                if not own and not (isinstance(node, ast.ImportFrom) and node.level):
                    yield wanted.split(".")[0], root.at(name, node.lineno)


def _imports(body: list[ast.stmt], main: bool) -> Iterator[ast.Import | ast.ImportFrom]:
    """The import statements of a module that always run."""
    for node in body:
        if isinstance(node, ast.Import | ast.ImportFrom):
            yield node
        elif isinstance(node, ast.With) or (
            main and isinstance(node, ast.If) and "__name__" in ast.unparse(node.test)
        ):
            yield from _imports(node.body, main)


def _own(roots: list[HostRepo], name: str) -> Iterator[tuple[HostRepo, str]]:
    """The host's own modules that an import of this name runs, and where they are found from."""
    parts = name.split(".")
    roots = [root for root in roots if not root.package or parts[0] == root.package]
    for end in range(1, len(parts) + 1):
        prefix = ".".join(parts[:end])
        yield from [(root, prefix) for root in roots if root.path(prefix)][:1]


def _inside(repo: HostRepo, package: str) -> bool:
    """Whether a checkout has a package in any folder, since hosts extend the path, or a folder."""
    files = (f"{package}.py", f"{package}/__init__.py")
    try:
        found = (repo.root / package).is_dir() or any(map(any, map(repo.root.rglob, files)))
        return found and not repo.package
    except OSError:  # too long a name for a file
        return False


def present(package: str) -> bool:
    """Whether an import would find a package here."""
    try:
        return find_spec(package) is not None
    except ValueError:  # a module without a spec, a stand-in of another tool
        return True
