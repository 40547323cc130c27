"""Reads the CUDA sources of a vendored rasterizer: do they draw by the rule that we know?

The import name of a rasterizer proves nothing: forks keep it and change the kernel.
"""

from __future__ import annotations

import ast
import math
import os
import re
from collections.abc import Iterator
from dataclasses import dataclass, replace
from functools import lru_cache
from pathlib import Path

from fragprune_plugins.adapting import Finding, HostRepo, nodes

_DEEPEST = 6  # folders below the checkout in which a rasterizer is looked for
_NOT_THEIRS = {"third_party", "build", "dist", "site-packages", "node_modules", "glm", "backward"}
_COMMENT = re.compile(r"//[^\n]*|/\*.*?\*/", re.DOTALL)
_CONSTANT = re.compile(r"^ *# *define\s+(\w+)\s+(\(?\d*\.[\d.f/ ]*\)?)\s*$", re.MULTILINE)
_ALPHA = re.compile(r"\b(?:float|double|auto)\s+alpha\s*=([^;]+);")
_BLENDS = re.compile(r"1(?:\.0?f?)?\s*-\s*alpha\b|\balpha\s*<\s*1")
"""What a blended alpha leaves of the light behind it, or when it is too faint to be blended."""
_BRANCHES = re.compile(r"\balpha\s*=(?!=)([^;]+);")  # of an alpha that is declared without a value
_JACOBIAN = re.compile(r"\bJ\s*=\s*(?:glm::)?mat3(?:x3)?\s*(\([^;]+\))\s*;")
_FILTER = re.compile(r"\bcov(?:\[(?:0\]\[0|1\]\[1)\]|\.x|\.z)\s*\+=?\s*(?!cov\b)([\w.]+)")
_NEAREST = "Gaussians nearer than"
_NUMBERS = {
    "fragments fainter than": (r"\balpha<\(?([\d.]+(?:/[\d.]+)?)\)?", 1 / 255),
    "no light below": (r"\btest_T<([\d.]+)\)\{?done=true", 1e-4),
    _NEAREST: (r"\bp_view\.z<=?([\d.]+)", 0.2),
    "Gaussians beyond this times their deviation:": (r"\bceil\(([\d.]+)\*sqrt\(", 3),
    "projections beyond this times the view:": (r"lim[xy]=([\d.]+)\*tan_fov", 1.3),
}
"""What a rasterizer leaves out or limits, and the number that it does so by."""
_ALWAYS = ("fragments fainter than", "no light below", _NEAREST)
"""Those of them that every rasterizer has."""
_COLOURS = re.compile(r"computeColorFromSH\([^;{]*\{(.*?)\breturn([^;]+);")
_OF_COLOURS = r"max\(\w+,(vec3\()?0\.?0?\)?\)"
_UNLIKE = re.compile(
    r"[;{})](?:(?:alpha|power)\*=[^;]+|(alpha|power)=\1\*[^;]+);|SortPairsDescending\(|"
    r"test_T=(?!T\*\(1(?:\.0?)?-\w*alpha\);)[^;]+;|C\[ch\]\+=[^;]+\*alpha;|"
    r"out_color\[[^]]*\]=(?:C\[ch\]|[^;]*/[^;]*);|\bpower<-?[\d.]+|"
    r"\bS\[([0-2])\]\[\2\]=(?!(?:\w+\*)?scale\.[xyz];)[^;]+;|"
    r"SH_C0=(?!0\.28209)[^;]+;|SH_C1=(?!0\.48860)[^;]+;|conic\.z,opacit\w+(?:\[\w+\])?\*\d[^}]*\}"
)
"""Code that draws otherwise."""
_EWA = re.compile(  # the third row is of depth: no picture has it
    r"\((\w+)/(\w+)\.z,0\.?0?,-\(?\1\*\2\.x\)?/\(\2\.z\*\2\.z\),"
    r"0\.?0?,(\w+)/\2\.z,-\(?\3\*\2\.y\)?/\(\2\.z\*\2\.z\),[^,]+,[^,]+,[^,]+\)"
)
_ORDER = re.compile(r"\bdepths\[idx\]\s*=([^;]+);")
_QUADRATIC = re.compile(
    r"-0\.5\*\((\w+)\.x\*(\w+)\.x\*\2\.x\+\1\.z\*\2\.y\*\2\.y\)-\1\.y\*\2\.x\*\2\.y"
)
_SURFEL = re.compile(r"-0\.5\*rho")
_POLYNOMIAL = re.compile(r"[\w.+()-]*(?:\*[\w.+()-]+){5,}")
"""Sums of products, as when a quadratic form is multiplied out; ours to read by a proof only."""
_LAUNCH = re.compile(r"\b(\w+)\s*(?:<[^<>;]*>)?\s*<<\s*<")
_KERNEL = re.compile(r"__global__[^;{(]*?(?:__launch_bounds__\s*\([^)]*\)\s*)?(\w+)\s*\(")
_LOW_PASS = 0.3
# codes of errors that are of the picture alone: a PLY is drawn in any order, and from any distance
ORDER, DISTANCE = "order", "distance"


@dataclass(frozen=True)
class Kernel:
    """How a rasterizer draws a Gaussian."""

    exponent: re.Pattern[str]  # of the falloff, as normalised source
    says: str  # the same for people
    projected: bool = True  # by the EWA Jacobian, and widened by a low-pass filter


SPLAT = Kernel(_QUADRATIC, "alpha = min(0.99, opacity exp(-q/2)), q from the conic")
SURFEL = Kernel(_SURFEL, "alpha = min(0.99, opacity exp(-rho/2))", projected=False)


def read_kernels(repo: HostRepo, package: str, kernel: Kernel) -> list[Finding]:
    """How the sources of a rasterizer that a checkout vendors differ from a known rule.

    An error for each difference, a warning where an exponent cannot be read.
    """
    return [each for project in _projects(repo, package) for each in project.compare(kernel)]


def normal_sources(repo: HostRepo, package: str) -> list[str]:
    """The CUDA sources of a vendored rasterizer that draw, in one spelling; empty without any."""
    texts = (text for project in _projects(repo, package) for text in project.texts.values())
    return [*map(_normal, texts)]


@lru_cache(maxsize=64)  # every call asks
def near(repo: HostRepo, package: str) -> float | None:
    """The view depth up to which a rasterizer leaves out Gaussians: that of 3DGS where it was not
    read, None where its sources name several.
    """
    pattern, usual = _NUMBERS[_NEAREST]
    found = [each for text in normal_sources(repo, package) for each in re.findall(pattern, text)]
    values = {*map(float, found)} or {usual}
    return values.pop() if len(values) == 1 else None


def backward_sources(repo: HostRepo, package: str) -> str:
    """Likewise what differentiates them, as one text."""
    files = (path for each in vendored(repo, package) for path in sorted(each.rglob("backward.cu")))
    return "".join(_normal(_COMMENT.sub("", repo.read(path))) for path in files)


@lru_cache(maxsize=64)  # of the adapters, many ask
def _projects(repo: HostRepo, package: str) -> tuple[_Project, ...]:
    return tuple(_Project(repo, each, package) for each in vendored(repo, package))


def vendored(repo: HostRepo, package: str) -> list[Path]:
    """Folders of a checkout that contain the package's import folder and CUDA sources, or that a
    file of this name has torch compile when it is imported.
    """
    if repo.package:
        return []
    name = package.rpartition(".")[2]
    calls = (each for each in nodes(repo.tree(package)) if isinstance(each, ast.Call))
    loads = [each for each in calls if any(word.arg == "sources" for word in each.keywords)]
    tree = repo.tree(package) if loads else None
    texts = (str(each.value) for each in nodes(tree) if isinstance(each, ast.Constant))
    named = [each for each in texts if each.endswith(".cu")]
    return [
        folder
        for folder, inside, _ in _folders(repo.root, _DEEPEST)
        if (name in inside and (folder / name / "__init__.py").is_file())
        or any((folder / each).is_file() for each in named)
        if any(_sources(folder))
    ]


def _folders(root: Path, deepest: float = math.inf) -> Iterator[tuple[Path, list[str], list[str]]]:
    """The folders below one, with the names of what is in them: folders and files, in order."""
    for path, inside, files in os.walk(root):
        folder = Path(path)
        own = (name for name in inside if not name.startswith(".") and name not in _NOT_THEIRS)
        inside[:] = sorted(own)
        yield folder, list(inside), sorted(files)
        if len(folder.relative_to(root).parts) >= deepest:
            inside.clear()


_CUDA_FILE = re.compile(r"[\"']([^\"'\s]+\.cu)[\"']")


def _compiled(repo: HostRepo, folder: Path) -> Iterator[Path]:
    """The CUDA sources of a project without those that its setup.py and its files do not name."""
    sources, setup = list(_sources(folder)), repo.read(folder / "setup.py")
    listed = _CUDA_FILE.findall(re.sub(r"#[^\n]*", "", setup))
    named = {*listed, *(each for path in sources for each in _CUDA_FILE.findall(repo.read(path)))}
    for path in sources:
        if not listed or path.suffix != ".cu" or any(path.match(each) for each in named):
            yield path


def _sources(folder: Path) -> Iterator[Path]:
    """The CUDA sources of a project that draw; ``backward`` only differentiates."""
    for path, _, files in _folders(folder):
        for name in files:
            stem, _, ending = name.partition(".")
            if ending in ("cu", "cuh", "h") and not stem.startswith("backward"):
                yield path / name


def _normal(text: str) -> str:
    """An expression in one spelling: no spaces, no float suffix, one name for each function."""
    text = re.sub(r"\s+|\(float\)|glm::|std::", "", text)
    text = re.sub(r"(?<=[\d.])f\b", "", text)
    return re.sub(r"\b(?:__)?(exp|fmin|min)f\b|\bfmin\b", lambda m: (m[1] or "min")[-3:], text)


class _Project:
    """The sources of one vendored rasterizer."""

    def __init__(self, repo: HostRepo, folder: Path, package: str) -> None:
        self.repo, self.folder, self.package = repo, folder, package
        texts = {
            path: _COMMENT.sub(lambda each: "\n" * each[0].count("\n"), repo.read(path))
            for path in _compiled(repo, folder)
        }
        numbers = dict(pair for text in texts.values() for pair in _CONSTANT.findall(text))
        named = re.compile(rf"\b({'|'.join(numbers) or '(?!)'})\b")
        self.texts = {k: named.sub(lambda m: numbers[m[1]], each) for k, each in texts.items()}

    def compare(self, kernel: Kernel) -> Iterator[Finding]:
        """The differences from a rule."""
        yield from self._alphas(kernel)
        yield from self._numbers()
        if kernel.projected:
            jacobians = list(self._found(_JACOBIAN))
            if not jacobians:
                yield self._finding(self.folder, 0, "no Jacobian of the projection", "EWA's")
            for path, position, text in jacobians:
                if not _EWA.fullmatch(text):
                    found = f"another projection, J = {_short(text)}"
                    yield self._finding(path, position, found, "the EWA projection")
            yield from self._filters()
            for path, position, text in self._found(_ORDER):
                if not re.fullmatch(r"\w*view\w*\.z", text):
                    found = f"Gaussians sorted by {_short(text)}"
                    finding = self._finding(path, position, found, "z in view space")
                    yield replace(finding, code=ORDER)

    def _alphas(self, kernel: Kernel) -> Iterator[Finding]:
        texts, known, unread = self.texts.values(), 0, []
        launched = {match[1] for text in texts for match in _LAUNCH.finditer(text)}
        for path, position, text in self._found(_ALPHA):
            if re.fullmatch(r"[\d.]+", text):  # a start, which the code below it changes
                continue
            if "exp(" not in text and not _BLENDS.search(self.texts[path]):
                continue  # of another kind, as a place in a triangle
            exponent = self._exponent(path, position, text)
            if exponent is None or "min(0.99," not in text:
                what = "no exp()" if exponent is None else "not capped at 0.99"
                yield self._finding(path, position, f"alpha = {_short(text)}: {what}", kernel.says)
            elif kernel.exponent.fullmatch(exponent):
                names = [each[1] for each in _KERNEL.finditer(self.texts[path], 0, position)]
                known += not launched or bool(launched.intersection(names[-1:]))
            else:
                unread.append((path, position, exponent))
        for path, position, exponent in unread:
            what = f"the exponent of alpha is {_short(exponent)}"
            other = not known and not (kernel.projected and _POLYNOMIAL.fullmatch(exponent))
            yield self._finding(path, position, what, kernel.says, error=other)
        if not known and not unread:
            others = (each for each in self._found(_BRANCHES) if "exp(" not in each[2])
            path, position, text = next(others, (self.folder, 0, ""))
            absent = "no alpha = min(0.99, opacity exp())"
            what = f"alpha = {_short(text)}: no exp()" if text else absent
            yield self._finding(path, position, what, kernel.says)

    def _numbers(self) -> Iterator[Finding]:
        """Other numbers than those that 3DGS leaves out fragments and Gaussians by, or none."""
        whole = "".join(map(_normal, self.texts.values()))
        for what, (pattern, usual) in ((each, _NUMBERS[each]) for each in _ALWAYS):
            if not re.search(pattern, whole):
                yield self._finding(self.folder, 0, f"no test for {what}", f"{usual:.4g}")
        for path, text in self.texts.items():
            normal = _normal(text)
            for what, (pattern, usual) in _NUMBERS.items():
                for match in re.finditer(pattern, normal):
                    above, _, below = match[1].partition("/")
                    if not math.isclose(float(above) / float(below or 1), usual, rel_tol=0.01):
                        at = self._place(path, match[0])
                        finding = self._finding(path, at, f"{what} {match[1]}", f"{usual:.4g}")
                        yield replace(finding, code=DISTANCE) if what == _NEAREST else finding
            for match in _UNLIKE.finditer(normal):
                code = match[0].lstrip(";{})")
                found = f"it draws otherwise, {_short(code)}"
                at = self._place(path, code)
                yield self._finding(path, at, found, "the rule of 3DGS")
            for inside, given in _COLOURS.findall(normal):
                if "+=0.5;" not in inside or not re.fullmatch(_OF_COLOURS, given):
                    found = f"colours of harmonics are {_short(given)}"
                    at = self._place(path, f"return{given}")
                    yield self._finding(path, at, found, "max(harmonics + 0.5, 0)")

    def _place(self, path: Path, code: str) -> int:
        """Where the line begins that holds a statement in one spelling; 0 if it has several."""
        lines = re.finditer(".+", self.texts[path])
        return next((each.start() for each in lines if code in _normal(each[0])), 0)

    def _exponent(self, path: Path, position: int, text: str) -> str | None:
        """The exponent of an alpha, with the variables that it goes through; None without exp."""
        for _ in range(3):
            if inner := re.search(r"exp\(([^()]*)\)", text):
                return self._assigned(path, position, inner[1]) or inner[1]
            names = re.findall(r"[*(,](\w+)\)", text)
            values = [each for name in names if (each := self._assigned(path, position, name))]
            text = next((each for each in values if "exp(" in each), "")
        return None

    def _assigned(self, path: Path, position: int, name: str) -> str | None:
        """The last value that a variable was declared with before a position."""
        if not name.isidentifier():
            return None
        declared = re.compile(rf"\b(?:float|auto)\s+{name}\s*=([^;]+);")
        before = [
            each[1] for each in declared.finditer(self.texts[path]) if each.start() < position
        ]
        return _normal(before[-1]) if before else None

    def _filters(self) -> Iterator[Finding]:
        added = list(self._found(_FILTER))
        if not added:
            yield self._finding(self.folder, 0, "no low-pass filter", f"{_LOW_PASS} added to it")
        for path, position, text in added:
            try:
                width = float(text)
            except ValueError:  # a name: a setting, which the call must pass, or a constant
                defined = re.compile(rf"\b{re.escape(text)}\s*=?\s*([\d.]+)f?\b")
                constant = list(self._found(defined))
                width = float(constant[0][2]) if constant else _LOW_PASS
                if not constant and self._assigned(path, len(self.texts[path]), text):
                    yield self._finding(path, position, f"Gaussians widened by {text}", "by 0.3")
            if width != _LOW_PASS:
                found = f"a low-pass filter of {width:g}"
                yield self._finding(path, position, found, f"one of {_LOW_PASS}")

    def _found(self, pattern: re.Pattern[str]) -> Iterator[tuple[Path, int, str]]:
        """File, position and normalised value of each match."""
        for path, text in self.texts.items():
            for match in pattern.finditer(text):
                yield path, match.start(), _normal(match[1])

    def _finding(
        self, path: Path, position: int, found: str, expected: str, *, error: bool = True
    ) -> Finding:
        """An error for what surely differs, a warning for what may."""
        at = path.relative_to(self.repo.root).as_posix()
        if path in self.texts:
            at += f":{self.texts[path].count(chr(10), 0, position) + 1}"
        where = f"{self.package} ({at})"
        if error:
            remedy = "Its pictures are not ours, so no adapter draws them."
            return Finding.error("kernel", where, found, expected, remedy)
        remedy = "It was not read any further; compare pictures on the first run."
        return Finding("warning", "kernel", where, found, expected, remedy)


def _short(text: str) -> str:
    return text if len(text) <= 60 else f"{text[:57]}..."
