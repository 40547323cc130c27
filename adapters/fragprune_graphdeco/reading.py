"""Reads what adapters of this family need: getters of the model and flags of the script."""

from __future__ import annotations

import ast
import contextlib
import operator
import re
from collections import Counter
from collections.abc import Callable, Collection, Iterable, Iterator, Mapping
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path
from typing import Any, TypeVar

from fragprune_plugins.adapting import (
    CommandLine,
    Finding,
    Function,
    HostRepo,
    UsageError,
    imported,
    is_off,
    nodes,
    off_by_default,
)

MODEL = "scene.gaussian_model"  # where 3DGS defines its model
GETTERS = ("xyz", "opacity", "scaling", "rotation")
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


def made_models(repo: HostRepo, module: str) -> list[str]:
    """Classes of models that a script makes, by their names, once for each place."""
    names = [getattr(each.func, "id", "") for each in every(repo.tree(module), ast.Call)]
    return [name for name in names if name.endswith("Model") or name.startswith("GaussianModel")]


_ELSEWHERE = re.compile(r"\w+(?:\.\w+)*\.(?:scene(?:\.\w+)*|gaussian_renderer)")


@lru_cache(maxsize=64)  # of the adapters, many ask
def failing(repo: HostRepo, scripts: tuple[str, ...]) -> tuple[str, ...]:
    """Why scripts fail or pass all seams by: modules that are imported under other names, which are
    others to Python; another framework; compiled training; calls that their functions do not take;
    a PLY that gets its name after it was saved.
    """
    found = [*_imported_elsewhere(repo)][:1]
    saving = text_of(repo.function("scene", "Scene.save"))
    if re.search(r"\b(os\.(replace|rename)|shutil\.move)\(", saving):
        found.append("Scene.save renames the PLY that it saves, and loses its thresholds")
    saver = ModelClass(repo).saver
    if saver and saver.name != "save_ply" and ".save_ply(" not in text_of(saver):
        found.append(f"Scene.save writes its PLY by {saver.name}, which saves no thresholds")
    found += [*_left_out(repo, scripts)][:1]
    for script in scripts:
        module = module_of(script)
        tree, home = repo.tree(module), home_of(repo, module)
        if home.startswith("scene") and home != MODEL:
            found.append(f"{script} trains the GaussianModel of {home}")
        if "jittor" in imported(tree):
            found.append(f"{script} trains by jittor")
        for node in learning(tree):
            if any("torch.compile" in text_of(each) for each in node.decorator_list):
                found.append(f"{script} compiles {node.name}, which trains")
        found += [*_broken(repo, module)][:1]
        found += (*_misfits(repo, module), *_absent(repo, module), *_own_options(repo, module))[:1]
        found += [f"{script} draws by {each}" for each in _drawn_elsewhere(repo, module)][:1]
    return tuple(found)


def _imported_elsewhere(repo: HostRepo) -> Iterator[str]:
    """Modules of the training code that are imported as if they lay in another folder."""
    for module in ("gaussian_renderer", "scene", MODEL, "train"):
        for node in getattr(repo.tree(module), "body", ()):
            if isinstance(node, ast.Import | ast.ImportFrom):
                name = next(iter(repo.imported_by(module, node)))
                top = name.split(".")[0]
                if _ELSEWHERE.fullmatch(name) and not (
                    repo.path(top) or (repo.root / top).is_dir()
                ):
                    at = repo.at(module, node.lineno)
                    yield f"{at} imports {name}, which is no module of this folder"


_OWN = ("arguments", "scene", "utils")
"""Packages that a codebase of this family has itself, without submodules."""


def _broken(repo: HostRepo, module: str) -> Iterator[str]:
    """Modules that a script cannot import, though it does at once, not only where they are there.

    A script in a folder may have others beside it.
    """
    alone, waiting = "." not in module, [module]
    own = ["train", *(each for each in _OWN if (repo.root / each).is_dir())] if alone else []
    for name in waiting:  # it grows
        body = getattr(repo.tree(name), "body", ())
        for node in (each for each in body if isinstance(each, ast.Import | ast.ImportFrom)):
            at, names = repo.at(name, node.lineno), _own_imports(repo, name, node)
            for each in (each for each in names if repo.path(each) and repo.tree(each) is None):
                yield f"imports {each}, which is no valid Python ({at})"
            for each in (each for each in names[:1] if each.split(".")[0] in own):
                path = each.replace(".", "/")
                if not ((repo.root / path).is_dir() or any(repo.root.glob(f"{path}.*"))):
                    yield f"imports {each}, which is not there ({at})"
            waiting += [each for each in names if each not in waiting]


def learning(tree: ast.AST | None) -> list[ast.FunctionDef]:
    """The functions that call a loss's ``backward``."""
    found = every(tree, ast.FunctionDef)
    return [f for f in found if any(getattr(n, "attr", "") == "backward" for n in nodes(f))]


def _left_out(repo: HostRepo, scripts: Iterable[str]) -> Iterator[str]:
    """Rows of the model that its PLY lacks, always or by what a call of ``save_ply`` names."""
    save = repo.function(MODEL, "GaussianModel.save_ply")
    taken = repo.parameters(MODEL, "GaussianModel.save_ply") or ()
    trees = map(repo.tree, ("scene", *map(module_of, scripts)))
    calls = [each for tree in trees for each in every(tree, ast.Call)]
    saving = [passed(each, taken) for each in calls if getattr(each.func, "attr", "") == "save_ply"]
    named = {name for each in saving for name, value in each.items() if not is_off(value)}
    off = off_by_default(save) - named if save else set()
    gone = skipped(save, lambda node: [None] if getattr(node, "id", "") in off else [])
    counted = [text_of(e.target) for e in every(save, ast.For) if "range(" in text_of(e.iter)]
    for each in (e for e in every(save, ast.Subscript) if text_of(e.slice) not in counted):
        if each not in gone and (of := chosen(each)) and _ROWS.fullmatch(text_of(of)):
            yield f"save_ply leaves out rows, {text_of(each)} ({repo.at(MODEL, each.lineno)})"


_ROWS = re.compile(r"xyz|attributes|elements|self\.(_|get_)xyz(\.\w+\(\))*")
"""The positions of a model, or all its values, in its save function."""


def _drawn_elsewhere(repo: HostRepo, module: str) -> Iterator[str]:
    """Functions beside ``gaussian_renderer`` by which a script draws, where that has its own, and
    functions in it without a rasterizer of 3DGS that draw in the place of others.
    """
    usual, known = "gaussian_renderer", as_options(repo, ("arguments", module))
    for node in every(repo.tree(module), ast.ImportFrom):
        beside = repo.absolute(module, node)
        for body in (repo.function(usual, each.name) for each in node.names if beside == usual):
            gone = skipped(body, known)
            for made in (each for each in every(body, ast.Return) if each not in gone):
                name = getattr(getattr(made.value, "func", None), "id", "")
                other, given = repo.function(usual, name), repo.parameters(usual, name) or ()
                shown = [text_of(each).split(".clamp(")[0] for each in entries(other, "render")]
                alone = "GaussianRasteriz" not in text_of(other)
                if alone and any(each not in given for each in shown):  # or it was drawn before
                    yield f"{name}, which calls no rasterizer of 3DGS"
        for each in node.names if beside != usual else ():
            home, found = _definition(repo, beside, each.name)
            own = _definition(repo, usual, each.name)[0]
            if own and home != own and "GaussianRasterizer(" in text_of(found):
                yield f"{each.name} of {home}, not of {usual}"


@lru_cache(maxsize=64)
def home_of(repo: HostRepo, module: str) -> str:
    """The module of the checkout that defines what a module calls GaussianModel; "" if unknown."""
    return _definition(repo, module, "GaussianModel")[0]


def class_of(model: ModelClass) -> ast.stmt | None:
    """The definition of a model's class."""
    return _definition(model.repo, model.module, model.name)[1]


def owners(tree: ast.AST | None) -> set[str]:
    """Variables, and lists and dicts, that hold models which a script makes."""
    pairs = assigned(tree)
    return {text_of(a).split("[")[0] for a, b in pairs if "GaussianModel(" in text_of(b)}


@lru_cache(maxsize=64)  # of the adapters, many ask
def _misfits(repo: HostRepo, module: str) -> tuple[str, ...]:
    """Calls of the checkout's own functions with values that these do not take, and of methods
    that the model lacks; without those that a script tries, or makes only where something is
    given or asked for.
    """
    tree, misfits = repo.tree(module), tuple[str, ...]()
    asked = [
        each
        for each in every(tree, ast.If)
        if isinstance(each.test, ast.Name) or "hasattr(" in text_of(each.test)
    ]
    parts = [*(each.body for each in asked), *(each.body for each in every(tree, ast.Try))]
    tried = {inner for part in parts for each in part for inner in nodes(each)}
    model = _definition(repo, MODEL, "GaussianModel")[1]
    pairs = [(text_of(to), text_of(value)) for to, value in assigned(tree)]
    models = {to for to, value in pairs if value.startswith("GaussianModel(")}
    models -= {to for to, value in pairs if not value.startswith("GaussianModel(")}
    gone = tried | skipped(tree, as_options(repo, ("arguments", module))).keys()
    texts = text_of(tree) + text_of(model)
    calls = [each for each in every(tree, ast.Call) if each not in gone]
    for node in sorted(calls, key=lambda each: (each.lineno, each.col_offset)):
        owner, _, name = text_of(node.func).rpartition(".")
        found, at = None, repo.at(module, node.lineno)
        if name in ("capture", "restore"):
            continue
        if owner in models and isinstance(model, ast.ClassDef):
            found = next((n for n in model.body if getattr(n, "name", "") == name), None)
            inherits = model.bases or "setattr(" in texts or f".{name} = " in texts
            if found is None and not inherits:
                misfits += (f"calls {name}, which its model lacks ({at})",)
        elif not owner and _bindings(tree)[name] == 1:
            found = model if name == "GaussianModel" else _definition(repo, module, name)[1]
        if why := _misfit(found, node, bool(owner)):
            misfits += (f"its call of {name} {why}, which fails ({at})",)
    return misfits


_OURS = ("source_path", "model_path", "iterations", "checkpoint_iterations", "start_checkpoint")
"""Options of a command that a run, or whoever starts it, relies on."""


def _own_options(repo: HostRepo, module: str) -> Iterator[str]:
    """Options that a script sets whatever its command says: one of ours, or all that a file has."""
    tree = repo.tree(module)
    body = getattr(tree, "body", ())
    asked = [node for node in body if isinstance(node, ast.If)]
    main = [each for node in asked if "__name__" in text_of(node.test) for each in node.body]
    known = as_options(repo, ("arguments", module))
    for node in (*body, *main):
        at = repo.at(module, node.lineno)
        if isinstance(node, ast.For) and _sets_any(node, skipped(tree, known)):
            yield f"sets options by {text_of(node.iter)}, whatever its command says ({at})"
        if not isinstance(node, ast.Assign):
            continue
        name = getattr(node.targets[0], "attr", "")
        if name in _OURS and f".{name}" not in text_of(node.value):
            yield f"sets {name} itself, whatever its command says ({at})"
        called = getattr(getattr(node.value, "func", None), "id", "")
        made = _definition(repo, module, called)[1]
        if isinstance(made, ast.FunctionDef) and _sets_any(made, skipped(made, known)):
            yield f"sets options by {called}, whatever its command says ({at})"


def overruling(repo: HostRepo, module: str) -> frozenset[str]:
    """Options, off by default, under which a script sets others whatever its command says."""
    tree, known = repo.tree(module), as_options(repo, ("arguments", module))
    imports = every(tree, ast.ImportFrom)
    homes = {each.name: repo.absolute(module, node) for node in imports for each in node.names}
    found = frozenset[str]()
    for node, test in skipped(tree, known).items():
        name = getattr(getattr(node, "func", None), "id", "")
        made = repo.function(homes.get(name, module), name) if name else None
        if name == "setattr" or (made and _sets_any(made, {})):
            found |= options_of(test, known)
    return found


def _sets_any(tree: ast.AST, gone: Mapping[ast.AST, ast.expr]) -> bool:
    """Whether code sets attributes by the names that it reads, or returns a namespace of them."""
    calls = {*every(tree, ast.Call)} - gone.keys()
    returned = [each.value for each in every(tree, ast.Return)]
    return any(
        text_of(each.func) == "setattr" or (each in returned and "Namespace(**" in text_of(each))
        for each in calls
    )


_ANY = "any key"


@lru_cache(maxsize=64)  # of the adapters, many ask
def _absent(repo: HostRepo, module: str) -> tuple[str, ...]:
    """Values that a script takes by name of what it drew, and that the drawing does not name."""
    tree, said, absent = repo.tree(module), dict[str, set[str]](), tuple[str, ...]()
    names = {
        each.asname or each.name: each.name
        for node in every(tree, ast.ImportFrom)
        for each in (node.names if node.module == "gaussian_renderer" else ())
    }
    for to, value in assigned(tree):
        name = names.get(getattr(getattr(value, "func", None), "id", ""), "")
        said.setdefault(text_of(to), set()).update(_given(repo, name) or {_ANY})
    for node in every(tree, ast.Call):  # what a script adds by another way than an item
        said.setdefault(text_of(node.func).removesuffix(".update"), set()).add(_ANY)
    gone = skipped(tree, as_options(repo, ("arguments", module)))
    items = [each for each in nodes(tree) if each not in gone and _key(each)]
    own = {_key(each) for each in items if isinstance(getattr(each, "ctx", None), ast.Store)}
    for each in (each for each in items if isinstance(each, ast.Subscript)):
        known = said.get(text_of(each.value), {_ANY}) | own
        if _ANY not in known and _key(each) not in known:
            at = repo.at(module, each.lineno)
            absent += (f"reads {_key(each)} of what it drew, which has no such value ({at})",)
    return absent


def _given(repo: HostRepo, name: str) -> set[str]:
    """Texts in a drawing function, the keys of its dict among them; empty if it may add others."""
    body = repo.function("gaussian_renderer", name) if name else None
    pairs = list(assigned(body))
    named = {text_of(node.value) for node in every(body, ast.Return) if node.value}
    made = [value for to, value in pairs if text_of(to) in named]
    made += [node.value for node in every(body, ast.Return) if isinstance(node.value, ast.Dict)]
    for node in every(body, ast.Call):
        owner, _, method = text_of(node.func).rpartition(".")
        made += node.args if owner in named and method == "update" else []
    texts = {str(each.value) for each in every(body, ast.Constant)}
    dicts = [each for each in made if isinstance(each, ast.Dict) and None not in each.keys]
    calls = any(isinstance(node.value, ast.Call) for node in every(body, ast.Return))
    known = "render" in texts and dicts and len(dicts) == len(made) and not calls
    return texts if known else set()


def _key(node: ast.AST) -> str:
    """The text by which an item is taken; "" if none is."""
    value = getattr(node.slice, "value", None) if isinstance(node, ast.Subscript) else None
    return value if isinstance(value, str) else ""


@lru_cache(maxsize=64)
def _bindings(tree: ast.AST | None) -> Counter[str]:
    """How often a module gives something a name."""
    kinds = ("name", "asname", "arg", "id")
    return Counter(
        name
        for node in nodes(tree)
        if not isinstance(node, ast.keyword)
        and isinstance(getattr(node, "ctx", ast.Store()), ast.Store)
        for name in {str(getattr(node, kind, None)) for kind in kinds}
    )


def _definition(
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
                return _definition(repo, repo.absolute(module, node), each.name, deep - 1)
    return "", None


def _misfit(called: ast.AST | None, call: ast.Call, of_model: bool) -> str:
    """How a call's values differ from those that a function, a method or a class takes; "" if they
    do not, or if that cannot be told.
    """
    made = isinstance(called, ast.ClassDef)
    own = [n for n in getattr(called, "body", ()) if getattr(n, "name", "") == "__init__"]
    function = (own[0] if own else None) if made else called
    given = [each.arg for each in call.keywords]
    loose = None in given or any(isinstance(each, ast.Starred) for each in call.args)
    if not isinstance(function, ast.FunctionDef) or function.decorator_list or loose:
        return ""
    taken, count = function.args, len(call.args)
    names = [each.arg for each in (*taken.posonlyargs, *taken.args)]
    needed = names[: len(names) - len(taken.defaults)]
    names, needed = (each[made or of_model :] for each in (names, needed))
    free = [*names[count:], *(each.arg for each in taken.kwonlyargs)]
    if count > len(names) and not taken.vararg:
        return f"gives {count} values of {len(names)}"
    more = [each for each in given if each not in free and not taken.kwarg]
    lacking = [each for each in needed[count:] if each not in given]
    return f"gives {more[0]}" if more else f"lacks {lacking[0]}" if lacking else ""


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
    for node in branching:
        taken = decided(node.test, known)
        branch = None if taken is None else node.orelse if taken else node.body
        for each in branch if isinstance(branch, list) else [branch]:
            found |= dict.fromkeys(nodes(each), node.test)
    return found


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
    values = [known(each) or _one([each]) for each in sides]
    if not all(values) or not any(map(known, sides)):
        return None
    if not isinstance(test, ast.Compare):
        return bool(values[0][0])
    compared = _COMPARED.get(type(test.ops[0]))
    with contextlib.suppress(TypeError):
        return bool(compared(values[0][0], values[1][0])) if compared and len(sides) == 2 else None
    return None


def as_options(repo: HostRepo, modules: Collection[str]) -> Known:
    """The values that modules give options by default."""
    return lambda node: by_default_of(repo, modules, option) if (option := _option(node)) else []


def options_of(test: ast.expr, known: Known) -> frozenset[str]:
    """The options that decide a test: those that are off by default, or else all."""
    values = {_option(each): known(each) for each in nodes(test) if _option(each)}
    off = [name for name, value in values.items() if value and not value[0]]
    return frozenset(off or (name for name, value in values.items() if value))


def _option(node: ast.AST) -> str:
    """The option that an expression is: ``args.x`` or ``getattr(args, "x", ...)``; "" if none."""
    if isinstance(node, ast.Call) and text_of(node.func) == "getattr":
        return str(getattr(node.args[1], "value", "")) if len(node.args) > 1 else ""
    return node.attr if isinstance(node, ast.Attribute) else ""


def by_default_of(repo: HostRepo, modules: Collection[str], option: str) -> list[Any]:
    """The one value that modules give an option by default; [] if it is not known."""
    return _one([value for module in modules for value in defaults(repo, module, option)])


def _one(given: list[Any]) -> list[Any]:
    """The value of expressions that are one and the same constant; [] if they are not."""
    try:
        values = [ast.literal_eval(each) for each in given]
    except (ValueError, TypeError, SyntaxError):
        return []
    return values[:1] if all(repr(each) == repr(values[0]) for each in values) else []


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
        if found := [k for k, name in parts.items() if len(repo.mentions([name], wanted)) > 1]:
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
            waiting += _own_imports(repo, module, node)
    return seen


def _own_imports(repo: HostRepo, module: str, node: ast.Import | ast.ImportFrom) -> list[str]:
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
    """``defaults`` of all names."""
    found: dict[str, list[ast.expr]] = {}
    for node in nodes(tree):
        if isinstance(node, ast.FunctionDef) and node.name == "__init__":
            for made in (each for each in nodes(node) if isinstance(each, ast.Assign)):
                owner, _, name = text_of(made.targets[0]).partition(".")
                if owner == "self":
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
