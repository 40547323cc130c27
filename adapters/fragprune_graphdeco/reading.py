"""Reads what adapters of this family need: the model, the scripts and their options."""

from __future__ import annotations

import ast
import re
from collections.abc import Collection, Iterable, Iterator, Mapping
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path
from types import MappingProxyType
from typing import Any

from fragprune_graphdeco.syntax import (
    Known,
    assigned,
    constant,
    decided,
    every,
    is_off,
    mentioned,
    skipped,
    text_of,
)
from fragprune_plugins.adapting import (
    CommandLine,
    Finding,
    Function,
    HostRepo,
    UsageError,
    imported,
    nodes,
)

MODEL = "scene.gaussian_model"  # where 3DGS defines its model
GETTERS = ("xyz", "opacity", "scaling", "rotation")
OPTIMIZER = re.compile(r"(torch\.)?(optim\.)?\w*(Adam|SGD|RMSprop)\w*\(")
"""A call that makes an optimizer."""
"""Values of a model that its properties give, by the names of their parameters."""
_SHAPES = {"repeat", "expand", "view", "reshape", "squeeze", "unsqueeze", "contiguous"}
"""Methods that change how often or in what shape a value stands, not the value."""
_FUNCTIONAL = ("torch.nn.functional", "nn.functional", "F")
ACTIVATIONS = {
    "scaling_activation": ("torch.exp", "jt.exp"),
    "opacity_activation": ("torch.sigmoid", "jt.sigmoid"),
    "rotation_activation": tuple(f"{each}.normalize" for each in (*_FUNCTIONAL, "jt")),
}
"""What activates each kind of value of a plain model."""
_JOINS = ("torch.cat", "torch.concat", "jt.cat", "jt.concat")
_ASKED = re.compile(r"self\.(\w+) is not None")
_OTHER_FLAGS = ("hydra", "omegaconf", "tyro", "jsonargparse", "fire", "gin", "click", "absl")


def mentions(repo: HostRepo, modules: Iterable[str], names: Iterable[str]) -> set[str]:
    """Which of the names occur as identifiers, attributes or parameters."""
    return set(names) & frozenset().union(*(mentioned(repo.tree(each)) for each in modules))


@dataclass(frozen=True)
class ModelClass:
    """A class of Gaussians in a checkout."""

    repo: HostRepo
    module: str = MODEL
    name: str = "GaussianModel"

    def method(self, name: str) -> Function | None:
        """Its definition."""
        return self.repo.function(self.module, f"{self.name}.{name}")

    def at(self, name: str) -> str:
        """The file:line of a method."""
        return self.repo.place(self.module, f"{self.name}.{name}")

    @property
    def saver(self) -> Function | None:
        """The method by which its scene, or else a script, writes a PLY."""
        calls = every(self.repo.function("scene", "Scene.save"), ast.Call)
        called = {getattr(each.func, "attr", "") for each in calls}
        names = {"save_ply"} & called or {e for e in called if re.match(r"save\w*ply", e)}
        return self.method(next(iter(sorted(names)), "")) or self.method("save_ply")

    @property
    def getters(self) -> dict[str, Function | None]:
        """By the kinds of values that they give."""
        return {kind: self.method(f"get_{kind}") for kind in GETTERS}


def read_getters(repo: HostRepo, unset: Collection[str] = ()) -> list[Finding]:
    """An error for each getter that is no property, or that gives other than its parameter.

    A threshold belongs to a row of the parameters. Attributes in ``unset`` are None.
    """
    found, model = [], ModelClass(repo)
    computed = computed_getters(model, unset)
    for kind, getter in model.getters.items() if repo.tree(MODEL) else ():  # else the seams say so
        decorators = " ".join(map(text_of, getter.decorator_list)) if getter else ""
        if kind in computed:
            made = (each.value for each in every(getter, ast.Return))
            ends = " or ".join(text_of(each) for each in made if each)
            what = f"get_{kind} is computed, it returns {ends[:60] or 'nothing'}"
        elif kind in ("xyz", "opacity") and "property" not in decorators:
            what = "a method" if getter else "no such property"
        else:
            continue
        at = f"{MODEL}:{model.name}.get_{kind} ({model.at(f'get_{kind}')})"
        expected = f"a property of the rows of self._{kind}, activated if they are no positions"
        found.append(Finding.error("model-getter", at, what, expected))
    return found


def computed_getters(model: ModelClass, unset: Collection[str] = ()) -> list[str]:
    """The kinds of values, and "features", whose getter gives other than its parameters.

    What getters do where attributes in ``unset`` are not None does not count.
    """
    found = []
    for kind, getter in model.getters.items():
        wanted = {"stored" if kind == "xyz" else "activated"}
        decorated = [text_of(each) for each in getter.decorator_list] if getter else []
        if getter and ({*decorated} - {"property"} or returns(getter, f"_{kind}", unset) != wanted):
            found.append(kind)
    features = model.method("get_features")
    other = any(text_of(each.func) not in _JOINS for each in every(features, ast.Call))
    return [*found, "features"] if other or every(features, ast.BinOp) else found


def unset(model: ModelClass) -> set[str]:
    """Attributes that getters of a model ask for, and that are None at first."""
    asked = {each for getter in model.getters.values() for each in _ASKED.findall(text_of(getter))}
    values = {each: defaults(model.repo, model.module, each) for each in asked}
    return {k for k, v in values.items() if v and all(getattr(n, "value", n) is None for n in v)}


def made_models(repo: HostRepo, module: str) -> list[str]:
    """Classes of models that a script makes, by their names, once for each place."""
    names = [getattr(each.func, "id", "") for each in every(repo.tree(module), ast.Call)]
    return [name for name in names if name.endswith("Model") or name.startswith("GaussianModel")]


def learning(tree: ast.AST | None) -> list[ast.FunctionDef]:
    """The functions that call a loss's ``backward``."""
    found = every(tree, ast.FunctionDef)
    return [f for f in found if any(getattr(n, "attr", "") == "backward" for n in nodes(f))]


@lru_cache(maxsize=64)
def home_of(repo: HostRepo, module: str) -> str:
    """The module of the checkout that defines what a module calls GaussianModel; "" if unknown."""
    return definition_of(repo, module, "GaussianModel")[0]


def owners(tree: ast.AST | None) -> set[str]:
    """Variables, and lists and dicts, that hold models which a script makes."""
    pairs = assigned(tree)
    return {text_of(a).split("[")[0] for a, b in pairs if "GaussianModel(" in text_of(b)}


def definition_of(
    repo: HostRepo, module: str, name: str, deep: int = 3
) -> tuple[str, ast.stmt | None]:
    """The function or class of a name in a module, also one that it imports from the checkout, with
    the module that defines it.
    """
    for node in getattr(repo.tree(module), "body", ()):
        if isinstance(node, ast.FunctionDef | ast.ClassDef) and node.name == name:
            return module, node
        for each in node.names if isinstance(node, ast.ImportFrom) and deep else ():
            if (each.asname or each.name) == name:
                return definition_of(repo, repo.absolute(module, node), each.name, deep - 1)
    return "", None


Named = Mapping[str, ast.expr]
"""What code calls by a name."""


def as_options(
    repo: HostRepo, modules: Collection[str], named: Named = MappingProxyType({})
) -> Known:
    """The values that modules give options by default, and with them what is called by a name."""

    def known(node: ast.AST) -> list[Any]:
        return by_default_of(repo, modules, option) if (option := _option(node)) else []

    def also(node: ast.AST) -> list[Any]:
        value = named.get(getattr(node, "id", ""))
        if value is None:
            return known(node)
        taken = decided(value, known)
        return known(value) or ([] if taken is None else [taken])

    return also


def options_of(test: ast.expr, known: Known, named: Named = MappingProxyType({})) -> frozenset[str]:
    """The options that decide a test: those that are off by default, or else all."""
    parts = [test, *(named.get(each.id) for each in every(test, ast.Name))]
    values = {_option(n): known(n) for each in parts for n in nodes(each) if _option(n)}
    off = [name for name, value in values.items() if value and not value[0]]
    return frozenset(off or (name for name, value in values.items() if value))


def _option(node: ast.AST) -> str:
    """The option that an expression is: ``args.x`` or ``getattr(args, "x", ...)``; "" if none."""
    if isinstance(node, ast.Call) and text_of(node.func) == "getattr":
        return str(getattr(node.args[1], "value", "")) if len(node.args) > 1 else ""
    return node.attr if isinstance(node, ast.Attribute) else ""


def by_default_of(repo: HostRepo, modules: Collection[str], option: str) -> list[Any]:
    """The one value that modules give an option by default; [] if it is not known."""
    return constant([value for module in modules for value in defaults(repo, module, option)])


def module_of(script: str) -> str:
    """The module that a script is, of a path below the checkout."""
    return script.removesuffix(".py").replace("/", ".")


def returns(getter: Function, stored: str, unset: Collection[str] = ()) -> set[str]:
    """What a getter returns: "stored" and "activated" rows of an attribute, or "computed" values.

    Positions in another shape are computed: their rows may be others.
    """
    activation = f"{stored[1:]}_activation"
    activations = (f"self.{activation}", *ACTIVATIONS.get(activation, ()))
    shapes = _SHAPES if stored != "_xyz" else set()
    made: dict[str, str] = {}

    def known(node: ast.AST) -> list[None]:
        return [None] if text_of(node).removeprefix("self.") in unset else []

    def state(value: ast.expr | None) -> str:
        if isinstance(value, ast.IfExp) and (taken := decided(value.test, known)) is not None:
            return state(value.body if taken else value.orelse)
        while isinstance(value, ast.Call) and getattr(value.func, "attr", "") in shapes:
            value = value.func.value  # type: ignore[attr-defined]
        if isinstance(value, ast.Call) and len(value.args) == 1 and not value.keywords:
            stands = text_of(value.func) in activations and state(value.args[0]) == "stored"
            return "activated" if stands else "computed"
        if isinstance(value, ast.Name):
            return made.get(value.id, "computed")
        return "stored" if value and text_of(value) == f"self.{stored}" else "computed"

    gone = skipped(getter, known)
    for statement in getter.body:
        for node in (each for each in nodes(statement) if each not in gone):
            if isinstance(node, ast.Assign) and isinstance(node.targets[0], ast.Name):
                name, new = node.targets[0].id, state(node.value)
                branch = node is not statement and name in made  # one of several
                made[name] = "computed" if branch and new != made[name] else new
    return {state(each.value) for each in every(getter, ast.Return) if each not in gone}


def options(model: ModelClass, scripts: Iterable[str]) -> set[str]:
    """What getters ask for that an option of its name, off by default, alone switches on."""
    branches = (n for each in model.getters.values() for n in every(each, ast.If, ast.IfExp))
    tests = {text_of(n.test) for n in branches}  # type: ignore[attr-defined]
    asked = {each.removeprefix("not ").removeprefix("self.") for each in tests}
    trees = map(model.repo.tree, (model.module, *scripts))
    made = {
        target.attr
        for target, value in (pair for tree in trees for pair in assigned(tree))
        if isinstance(target, ast.Attribute)
        and not is_off(value)
        and text_of(value).split(".")[-1] != target.attr
    }
    names = {each: each.split(".")[-1] for each in asked}
    off = {each for each in asked if off_in(model.repo, ("arguments",), names[each])}
    return {each for each in off if names[each] not in made}


def state(capture: Function | None) -> list[ast.expr]:
    """What a method returns as a tuple, the longest of several."""
    given = (node.value for node in every(capture, ast.Return))
    listed = (each.elts for each in given if isinstance(each, ast.Tuple | ast.List))
    return max(listed, key=len, default=[])


def _taken_back(restore: Function | None) -> list[int]:
    """Into how many values a method unpacks its first argument."""
    first = [each.arg for each in restore.args.args[1:2]] if restore else []
    unpacked = (to for to, value in assigned(restore) if getattr(value, "id", "") in first)
    several = (each for each in unpacked if isinstance(each, ast.Tuple))
    return [len(each.elts) for each in several if not every(each, ast.Starred)]


def uneven(capture: Function | None, restore: Function | None) -> str:
    """How a method takes back another number of values than one gives; "" if it does not."""
    taken, given = _taken_back(restore), state(capture)
    fixed = [each for each in given if not isinstance(each, ast.Starred)]
    more = len(given) - len(fixed)
    if not given or not taken or any(n >= len(fixed) if more else n == len(fixed) for n in taken):
        return ""
    return f"its restore takes {taken[0]} values, and capture gives {len(given)}"


SCRIPTS = ("*train*.py", "*.py")
"""Which files of a folder may be training scripts: those of the first that finds any."""


def training_scripts(repo: HostRepo, *patterns: str) -> tuple[str, ...]:
    """Scripts that train, the usual one first, by the first of the patterns that finds any."""
    for pattern in patterns or SCRIPTS:
        files = sorted(repo.root.glob(pattern), key=lambda each: (each.stem != "train", each))
        paths = [each.relative_to(repo.root) for each in files if "." not in each.stem]
        parts = {each.as_posix(): ".".join(each.with_suffix("").parts) for each in paths}
        wanted = ("training_setup", "backward")
        if found := [k for k, name in parts.items() if len(mentions(repo, [name], wanted)) > 1]:
            return tuple(found)
    return ()


def reached(repo: HostRepo, modules: Iterable[str], without: str = "") -> dict[str, ast.Module]:
    """Modules and those of the checkout that they import, without one and what it imports."""
    waiting, seen = [*modules], dict[str, ast.Module]()
    while waiting:
        module = waiting.pop(0)
        tree = repo.tree(module)
        if module in seen or tree is None or module.split(".")[0] == without:
            continue
        seen[module] = tree
        statements: tuple[Any, ...] = every(tree, ast.Import, ast.ImportFrom)
        for node in statements:
            waiting += own_imports(repo, module, node)
    return seen


def own_imports(repo: HostRepo, module: str, node: ast.Import | ast.ImportFrom) -> list[str]:
    """What a statement may import of the host: beside an installed one lie all other packages."""
    names = repo.imported_by(module, node)
    return [each for each in names if repo.package in ("", each.split(".")[0])]


def defaults(repo: HostRepo, module: str, name: str) -> list[ast.expr]:
    """What the classes of a module first assign to ``self.name``, and defaults of that option."""
    return _defaults(repo.tree(module)).get(name, [])


def off_in(repo: HostRepo, modules: Iterable[str], name: str) -> bool:
    """Whether what modules assign to ``self.name``, or to an option, is None or False at first."""
    given = [each for module in modules for each in defaults(repo, module, name)]
    return bool(given) and all(map(is_off, given))


@lru_cache(maxsize=256)
def _defaults(tree: ast.Module | None) -> dict[str, list[ast.expr]]:
    """``defaults`` of all names, without what is counted on."""
    found: dict[str, list[ast.expr]] = {}
    counted = {text_of(each.target) for each in every(tree, ast.AugAssign)}
    for node in nodes(tree):
        if isinstance(node, ast.FunctionDef) and node.name == "__init__":
            for made in (each for each in nodes(node) if isinstance(each, ast.Assign)):
                owner, _, name = text_of(made.targets[0]).partition(".")
                if owner == "self" and f"self.{name}" not in counted:
                    found.setdefault(name, []).append(made.value)
        elif isinstance(node, ast.Call) and getattr(node.func, "attr", "") == "add_argument":
            given = {each.arg: each.value for each in node.keywords}
            action = getattr(given.get("action"), "value", "")
            switch = {"store_true": False, "store_false": True}.get(str(action))
            for each in filter(None, (getattr(name, "value", "") for name in node.args)):
                value = given.get("default", ast.Constant(switch))
                found.setdefault(str(each).removeprefix("--"), []).append(value)
    return found


def read_flags(repo: HostRepo, line: CommandLine) -> Iterator[Finding]:
    """An error for each training script that lacks a flag that we set, or reads no flags."""
    wanted = ("iterations", "output", "save_checkpoints", "resume")
    for script in line.scripts:
        tree = repo.tree(module_of(script))
        if tree is None:
            continue
        called = (getattr(node.func, "id", "") for node in every(tree, ast.Call))
        parts = (tree, *(repo.function("arguments", each) for each in called if each))
        read = {node.attr for each in parts for node in every(each, ast.Attribute)}
        if read.isdisjoint(("parse_args", "parse_known_args")):
            others = ", ".join(name for name in imported(tree) if name in _OTHER_FLAGS)
            found = f"it reads its settings with {others}" if others else "no argparse"
            expected = "flags, read with argparse"
        else:
            flags = {*_strings(tree), *_of_groups(repo)}
            needed = filter(None, map(line.spellings, wanted))
            missing = ", ".join(each[-1] for each in needed if not flags.intersection(each))
            found, expected = f"no {missing}" if missing else "", "the flags that we set"
        if found:
            yield Finding.error("flags", script, found, expected, "Its training cannot be driven.")


def in_full(repo: HostRepo, script: Path, arguments: list[str]) -> list[str]:
    """Arguments in which the beginning of a long flag is written out, as argparse completes it.

    A flag is what looks like one in the script and in what it imports of its checkout, and what
    groups make. Those of a script that lies elsewhere are unknown.

    Raises:
        UsageError: several flags begin so.
    """
    if not script.resolve().is_relative_to(repo.root):
        return arguments
    module = module_of(script.resolve().relative_to(repo.root).as_posix())
    trees = [repo.tree(module)] if repo.package else reached(repo, [module]).values()
    flags = {*_of_groups(repo), *(each for tree in trees for each in _strings(tree))}
    whole = []
    for word in arguments:
        name, *value = word.split("=", 1)
        begun = sorted(each for each in flags if name[:2] == "--" and each.startswith(name))
        if len(begun) > 1 and name not in begun and name != "--":
            expected = f"one of {', '.join(begun)}"
            raise UsageError(name, "an abbreviation of several flags", expected, "Write it out.")
        whole.append("=".join([begun[0] if len(begun) == 1 else name, *value]))
    return whole


def _strings(tree: ast.Module | None) -> Iterator[str]:
    """Strings in a script that could be flags."""
    for node in every(tree, ast.Constant):
        if isinstance(node.value, str) and re.fullmatch(r"--?\w[\w-]*", node.value):
            yield node.value


def _of_groups(repo: HostRepo) -> Iterator[str]:
    """Flags that the argument groups make of their attributes; ``_name`` also makes ``-n``.

    Modules beside them may add others.
    """
    for path in sorted((repo.root / "arguments").glob("*.py")):
        tree = repo.tree(f"arguments.{path.stem}") if path.stem != "__init__" else None
        yield from _strings(tree)
    for each, _ in assigned(repo.tree("arguments")):
        if isinstance(each, ast.Attribute) and text_of(each.value) == "self":
            yield f"--{each.attr.removeprefix('_')}"
            if each.attr.startswith("_"):
                yield f"-{each.attr[1]}"


def training_modules(repo: HostRepo) -> list[str]:
    """Modules of the scripts that train, by their names, or else by what they do."""
    named = sorted(each.stem for each in repo.root.glob("*train*.py") if each.stem.isidentifier())
    return named or [*map(module_of, training_scripts(repo))]


@lru_cache(maxsize=16)
def texts_of(repo: HostRepo) -> dict[Path, str]:
    """The files of a codebase that may draw or save its model, with their text."""
    paths = [path for each in ("", "*/", "*/*/") for path in sorted(repo.root.glob(f"{each}*.py"))]
    texts = {each: repo.read(each) for each in paths}
    return {k: v for k, v in texts.items() if k.parent.name != "scene" or "def save" not in v}
