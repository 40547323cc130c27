"""What makes a training script fail, or pass all seams by, in a checkout."""

from __future__ import annotations

import ast
import builtins
import math
import re
from collections import Counter
from collections.abc import Iterable, Iterator, Mapping
from functools import lru_cache
from typing import Any

from fragprune_graphdeco.reading import (
    MODEL,
    ModelClass,
    as_options,
    by_default_of,
    definition_of,
    home_of,
    learning,
    module_of,
    options_of,
    own_imports,
    reached,
    texts_of,
)
from fragprune_graphdeco.syntax import (
    assigned,
    chosen,
    decided,
    entries,
    every,
    is_off,
    off_by_default,
    passed,
    skipped,
    text_of,
)
from fragprune_plugins.adapting import HostRepo, imported, nodes

_RASTERIZES = "GaussianRasterizer("
_ELSEWHERE = re.compile(r"\w+(?:\.\w+)*\.(?:scene(?:\.\w+)*|gaussian_renderer)")


@lru_cache(maxsize=64)  # of the adapters, many ask
def reasons(repo: HostRepo, scripts: tuple[str, ...]) -> tuple[str, ...]:
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
    found += [*_left_out(repo, scripts), *_of_scene(repo), *_of_authors(repo, scripts)][:1]
    found += [*unlike_3dgs(repo)][:1]
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
        found += [*_unbound(repo, module)][:1]
        found += (*_misfits(repo, module), *_absent(repo, module), *_own_options(repo, module))[:1]
        found += [*_of_cameras(repo, module), *_of_options(repo, module)][:1]
        found += [*_untyped(repo, module)][:1]
        found += [*_unmade(repo, module), *_into_none(repo, module)][:1]
        ends = (why for why, asked in _ends(repo, module) if not asked)
        found += [f"{script} {why}" for why in (*ends, *_by_another(repo, module))][:1]
        found += [f"{script} draws by {each}" for each in _drawn_elsewhere(repo, module)][:1]
        found += [f"{script} makes {each}" for each in _other_scenes(repo, module)][:1]
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
            at, names = repo.at(name, node.lineno), own_imports(repo, name, node)
            for each in (each for each in names if repo.path(each) and repo.tree(each) is None):
                yield f"imports {each}, which is no valid Python ({at})"
            for each in (each for each in names[:1] if each.split(".")[0] in own):
                path = each.replace(".", "/")
                if not ((repo.root / path).is_dir() or any(repo.root.glob(f"{path}.*"))):
                    yield f"imports {each}, which is not there ({at})"
            if alone and isinstance(node, ast.ImportFrom):
                for each in _lacking(repo, repo.absolute(name, node), node):
                    yield f"imports {each} ({at})"
            waiting += [each for each in names if each not in waiting]


def _lacking(repo: HostRepo, home: str, node: ast.ImportFrom) -> Iterator[str]:
    """Names that a statement imports from a module of the checkout, and that this does not have."""
    bound = bindings(repo.tree(home))
    for name in (each.name for each in node.names if repo.tree(home)):
        inside = repo.path(f"{home}.{name}") or (repo.root / home.replace(".", "/") / name).is_dir()
        if not (inside or name.startswith(("_", "*")) or {name, "*", "__getattr__"} & bound.keys()):
            yield f"{name}, which {home} lacks"


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
    trains = learning(repo.tree(module))
    calls = (n for f in trains for n in {*every(f, ast.Call)} - skipped(f, known).keys())
    called = {n.func.id for n in calls if isinstance(n.func, ast.Name)}
    for each in getattr(repo.tree(module), "body", ()) if repo.tree(usual) else ():
        if (getattr(each, "name", "") in called or each in trains) and _RASTERIZES in text_of(each):
            yield f"{each.name} of its own, not of {usual}"
    for node in every(repo.tree(module), ast.ImportFrom):
        beside = repo.absolute(module, node)
        drawing = [each for each in node.names if beside == usual]
        names = [each.name for each in drawing if (each.asname or each.name) in called]
        for body in (repo.function(usual, each.name) for each in drawing):
            gone = skipped(body, known)
            returned = (each.value for each in every(body, ast.Return) if each not in gone)
            names += [getattr(getattr(each, "func", None), "id", "") for each in returned]
        for name in names:
            other, given = repo.function(usual, name), repo.parameters(usual, name) or ()
            shown = [text_of(each).split(".clamp(")[0] for each in entries(other, "render")]
            uses = (repo.function(usual, each.id) for each in every(other, ast.Name))
            alone = not any("GaussianRasteriz" in text_of(each) for each in (other, *uses))
            if alone and any(each not in given for each in shown):  # or it was drawn before
                yield f"{name}, which calls no rasterizer of 3DGS"
        for each in node.names if beside != usual else ():
            home, found = definition_of(repo, beside, each.name)
            own = definition_of(repo, usual, each.name)[0]
            if own and home != own and _RASTERIZES in text_of(found):
                yield f"{each.name} of {home}, not of {usual}"


@lru_cache(maxsize=64)  # of the adapters, many ask
def _misfits(repo: HostRepo, module: str) -> tuple[str, ...]:
    """Calls of the checkout's own functions with values that these do not take, and of methods
    that the model lacks; without those that a script tries, or makes only where something is
    given or asked for.
    """
    tree, misfits, gone = repo.tree(module), tuple[str, ...](), _perhaps(repo, module)
    calls = [each for each in every(tree, ast.Call) if each not in gone]
    called, texts = dict[str, set[str]](), text_of(tree) + text_of(repo.tree(MODEL))
    for to, value in assigned(tree):
        called.setdefault(text_of(to), set()).add(text_of(getattr(value, "func", None)))
    unpacked = {value: to for to, value in assigned(tree) if isinstance(to, ast.Tuple)}
    for node in sorted(calls, key=lambda each: (each.lineno, each.col_offset)):
        owner, _, name = text_of(node.func).rpartition(".")
        if name in ("capture", "restore"):
            continue
        of, *others = called.get(owner, {""}) if owner else {name}
        if others or not (owner or bindings(tree)[name] == 1):
            of = ""  # a name of several things
        at = repo.at(module, node.lineno)
        home, found = definition_of(repo, MODEL if of == "GaussianModel" else module, of)
        model = found if owner else None
        if owner:
            body = model.body if isinstance(model, ast.ClassDef) else []
            found = next((each for each in body if getattr(each, "name", "") == name), None)
            if of in ("GaussianModel", "Scene") and _lacks(model, name, texts):
                misfits += (f"calls {name}, which {of} lacks ({at})",)
        if why := misfit(found, node, bool(owner)):
            misfits += (f"its call of {name} {why}, which fails ({at})",)
        taken, given = unpacked.get(node), _lengths(repo, home, model, found)
        if taken and given and not every(taken, ast.Starred) and len(taken.elts) not in given:
            what = f"takes {len(taken.elts)} values of {name}, which gives {min(given)}"
            misfits += (f"{what} ({at})",)
    return misfits


def _lacks(model: ast.AST | None, name: str, texts: str) -> bool:
    """Whether a class neither has a method, nor may inherit it, nor is given it in code."""
    if not isinstance(model, ast.ClassDef) or model.bases:
        return False
    has = any(getattr(each, "name", "") == name for each in model.body)
    return not (has or "setattr(" in texts or f".{name} = " in texts)


def _of_scene(repo: HostRepo) -> Iterator[str]:
    """Methods that the scene calls of the model whatever is asked for, and that the model lacks, or
    that do not take the values of these calls.
    """
    tree, model = repo.tree("scene"), definition_of(repo, MODEL, "GaussianModel")[1]
    texts = text_of(tree) + text_of(repo.tree(MODEL))
    asked = [each for each in every(tree, ast.If) if "loaded_iter" not in text_of(each.test)]
    perhaps = {inner for each in (*asked, *every(tree, ast.Try)) for inner in nodes(each)}
    for node in (each for each in every(tree, ast.Call) if each not in perhaps):
        owner, _, name = text_of(node.func).rpartition(".")
        if owner != "self.gaussians":
            continue
        at, method = repo.at("scene", node.lineno), repo.function(MODEL, f"GaussianModel.{name}")
        if _lacks(model, name, texts):
            yield f"its scene calls {name}, which GaussianModel lacks ({at})"
        if why := misfit(method, node, of_model=True):
            yield f"its scene's call of {name} {why}, which fails ({at})"
        given = passed(node, repo.parameters(MODEL, f"GaussianModel.{name}") or ())
        lists = {key for key, value in given.items() if text_of(value).startswith("scene_info.")}
        for item in every(method, ast.Subscript):
            between = isinstance(getattr(item.slice, "value", None), float)
            if between and text_of(item.value) in lists:
                yield f"its model takes {text_of(item)} of a list ({at})"


def _other_scenes(repo: HostRepo, module: str) -> Iterator[str]:
    """Scenes that a script makes, and that are made without the ``__init__`` of ``Scene``."""
    functions = learning(repo.tree(module))
    for call in (each for function in functions for each in every(function, ast.Call)):
        _, made = definition_of(repo, module, getattr(call.func, "id", ""))
        own = [n for n in getattr(made, "body", ()) if getattr(n, "name", "") == "__init__"]
        name, bases = getattr(made, "name", ""), map(text_of, getattr(made, "bases", ()))
        calls = any("super().__init__(" in text_of(each) for each in own)
        if own and not calls and name != "Scene" and "Scene" in " ".join([name, *bases]):
            yield f"{name}, no Scene ({repo.at(module, call.lineno)})"


def unlike_3dgs(repo: HostRepo) -> Iterator[str]:
    """Panoramas, by an angle of a camera that no plane can show; and a PLY of more channels."""
    for text in every(repo.tree(MODEL), ast.Constant):
        if text.value == "f_dc_3":
            at = repo.at(MODEL, text.lineno)
            yield f"its PLY may have a further channel, f_dc_3 ({at})"
    module = "scene.dataset_readers"
    words = [each for call in every(repo.tree(module), ast.Call) for each in call.keywords]
    for each in (each for each in words if each.arg in ("FovX", "FovY")):
        angle = getattr(each.value, "value", 0)
        if isinstance(angle, int | float) and angle > math.pi:
            at = repo.at(module, each.lineno)
            yield f"its cameras are no pinholes, {each.arg}={angle} ({at})"


def _of_authors(repo: HostRepo, scripts: Iterable[str]) -> Iterator[str]:
    """Files that the scene, the model as it is made, or what else scripts make loads by a path of
    its author's, whatever the command says.
    """
    made = [("scene", "scene", "Scene.__init__")]
    made.append(("model", MODEL, "GaussianModel.create_from_pcd"))
    for module in map(module_of, scripts):
        calls = [each for part in learning(repo.tree(module)) for each in every(part, ast.Call)]
        for name in sorted({e.func.id for e in calls if isinstance(e.func, ast.Name)}):
            home, found = definition_of(repo, module, name)
            if isinstance(found, ast.ClassDef):
                made.append((found.name, home, f"{found.name}.__init__"))
    for what, module, name in made:  # it grows
        for node in _surely(repo, module, getattr(repo.function(module, name), "body", ())):
            calls = [*every(node, ast.Call)]
            first = [arg for each in calls for arg in each.args[:1]]
            for value in (*first, getattr(node, "value", None)):
                path = getattr(value, "value", "") if isinstance(value, ast.Constant) else ""
                if re.fullmatch(r"(/|[A-Z]:)\S+\.\w+", str(path)):
                    yield f"its {what} loads {path} ({repo.at(module, node.lineno)})"
            names = (text_of(each.func).partition("self.")[2] for each in calls)
            inner = [(what, module, f"{name.partition('.')[0]}.{each}") for each in names]
            made += [each for each in inner if each not in made]


def _surely(repo: HostRepo, module: str, body: Iterable[ast.stmt]) -> Iterator[ast.stmt]:
    """Simple statements that code does whatever is asked for; a module's constants are known."""
    top = [n for n in getattr(repo.tree(module), "body", ()) if isinstance(n, ast.Assign)]
    constants = {text_of(to): each.value for each in top for to in each.targets}

    def known(node: ast.AST) -> list[Any]:
        value = constants.get(text_of(node))
        return [value.value] if isinstance(value, ast.Constant) else []

    for node in body:
        if isinstance(node, ast.If) and (taken := decided(node.test, known)) is not None:
            yield from _surely(repo, module, node.body if taken else node.orelse)
        elif isinstance(node, ast.Assign | ast.Expr):
            yield node


_CAMERA = re.compile(r"viewpoint(_?cam(era)?)?")
"""What scripts call a camera of their scene."""


def _of_cameras(repo: HostRepo, module: str) -> Iterator[str]:
    """Attributes that a script reads of its cameras, and that nothing sets but for cameras that
    derive from those.
    """
    tree, camera = repo.tree(module), repo.definition("scene.cameras", "Camera")
    bases = {text_of(each) for each in getattr(camera, "bases", ())}
    made = "return Camera(" in text_of(repo.function("utils.camera_utils", "loadCam"))
    if not made or bases - {"nn.Module", "torch.nn.Module", "object"}:
        return
    classes = every(repo.tree("scene.cameras"), ast.ClassDef)
    alike = [each for each in classes if "Camera" not in map(text_of, each.bases)]
    own = {text_of(node) for each in alike for node in every(each, ast.Attribute)}
    own |= {f"self.{getattr(node, 'name', '')}" for each in alike for node in nodes(each)}
    texts = "".join(map(repo.read, sorted(repo.root.glob("scene/*.py"))))
    texts += "".join(texts_of(repo).values())
    called = {each.func for each in every(tree, ast.Call)} | _perhaps(repo, module)
    for node in (each for each in every(tree, ast.Attribute) if each not in called):
        name, of_camera = node.attr, _CAMERA.fullmatch(getattr(node.value, "id", ""))
        given = rf"(?<!self)\.{name}\b[^=(),\n]*=(?!=)|['\"]{name}['\"]"
        if of_camera and f"self.{name}" not in own and not re.search(given, texts):
            yield f"reads {name} of a camera, which has none ({repo.at(module, node.lineno)})"


def _of_options(repo: HostRepo, module: str) -> Iterator[str]:
    """Options that a script reads of what a group extracts, and that the group does not have."""
    tree, gone = repo.tree(module), _perhaps(repo, module)
    makes = {text_of(to): text_of(getattr(made, "func", None)) for to, made in assigned(tree)}
    whole = "in vars(self)" in text_of(repo.function("arguments", "ParamGroup.extract"))
    for function in learning(tree) if whole else ():
        takes = [each.arg for each in function.args.args]
        calls = repo.calls(module, function.name)
        for name, value in (each for call in calls for each in passed(call, takes).items()):
            group = makes.get(text_of(value).partition(".extract(")[0], "")
            made = repo.definition("arguments", group) if group else None
            own = {each.attr.removeprefix("_") for each in every(made, ast.Attribute)}
            other = made is None or name in {text_of(to) for to, _ in assigned(function)}
            read = (each for each in every(function, ast.Attribute) if each not in gone)
            for node in read if not other else ():
                option = f"{name}.{node.attr}"
                if text_of(node) == option and node.attr not in {*own, "__dict__"}:
                    given = re.compile(rf"\b({option} = |{name}\.__dict__)|(set|has)attr\({name}\b")
                    if not any(map(given.search, (text_of(tree), *texts_of(repo).values()))):
                        at = repo.at(module, node.lineno)
                        yield f"reads {option}, and {group} has no such option ({at})"


def _lengths(
    repo: HostRepo, module: str, owner: ast.AST | None, function: ast.AST | None
) -> set[int]:
    """How many values a function of a module, or a method of a class in it, may return, also by a
    network of that class; empty if that is unknown.
    """
    plain = isinstance(function, ast.FunctionDef) and not function.decorator_list
    body = nodes(function if plain and not every(function, ast.Yield) else None)
    found = set[int]()
    inner = {n for f in body[1:] if isinstance(f, ast.FunctionDef) for n in nodes(f)}
    for value in (n.value for n in body if isinstance(n, ast.Return) and n not in inner):
        lengths = {len(value.elts)} if isinstance(value, ast.Tuple) else set[int]()
        asked = text_of(value.func) if isinstance(value, ast.Call) else ""
        for made in (made for to, made in assigned(owner) if text_of(to) == asked):
            home, net = definition_of(repo, module, next((n.id for n in every(made, ast.Name)), ""))
            forward = (n for n in nodes(net) if getattr(n, "name", "") == "forward")
            lengths |= _lengths(repo, home, None, next(forward, None))
        if not lengths or every(value, ast.Starred):
            return set()
        found |= lengths
    return found


@lru_cache(maxsize=64)
def _perhaps(repo: HostRepo, module: str) -> frozenset[ast.AST]:
    """What a script tries, does only where something is given or asked for, or does not do."""
    tree = repo.tree(module)
    asked = [
        each
        for each in every(tree, ast.If)
        if isinstance(each.test, ast.Name) or "hasattr(" in text_of(each.test)
    ]
    parts = [*(each.body for each in asked), *(each.body for each in every(tree, ast.Try))]
    tried = {inner for part in parts for each in part for inner in nodes(each)}
    return frozenset(tried | skipped(tree, as_options(repo, ("arguments", module))).keys())


def _unbound(repo: HostRepo, module: str) -> Iterator[str]:
    """Names that a function reads which trains, and that neither it nor its script defines."""
    tree, gone = repo.tree(module), _perhaps(repo, module)
    functions = [nodes(each) for each in every(tree, ast.FunctionDef)]
    inside = {node for each in functions for node in each[1:]}
    outside = [each for each in nodes(tree) if each not in inside or isinstance(each, ast.Global)]
    for part in learning(tree):
        around = (node for each in functions if part in each for node in each)
        bound = {*named([*outside, *around]), *dir(builtins), "__file__"}
        for name in (each for each in every(part, ast.Name) if each not in gone):
            if name.id not in bound and "*" not in bound:
                yield f"reads {name.id}, which nothing defines ({repo.at(module, name.lineno)})"


_OURS = ("source_path", "model_path", "iterations", "checkpoint_iterations", "start_checkpoint")
"""Options of a command that a run, or whoever starts it, relies on."""


def _own_options(repo: HostRepo, module: str) -> Iterator[str]:
    """Options that a script sets whatever its command says: one of ours, or all that a file has."""
    tree = repo.tree(module)
    known = as_options(repo, ("arguments", module))
    gone = skipped(tree, known)
    functions = {n for f in every(tree, ast.FunctionDef) for n in _started(f.body) if n not in gone}
    for node in (*_started(getattr(tree, "body", ())), *functions):
        at = repo.at(module, node.lineno)
        if isinstance(node, ast.For) and node not in functions and _sets_any(node, gone):
            yield f"sets options by {text_of(node.iter)}, whatever its command says ({at})"
        if not isinstance(node, ast.Assign):
            continue
        name = _overruled(node)
        if name and (name == "iterations" or node not in functions):
            yield f"sets {name} itself, whatever its command says ({at})"
        called = getattr(getattr(node.value, "func", None), "id", "")
        made = definition_of(repo, module, called)[1]
        if isinstance(made, ast.FunctionDef) and _sets_any(made, skipped(made, known)):
            yield f"sets options by {called}, whatever its command says ({at})"


def _overruled(node: ast.AST) -> str:
    """The option of ours that a statement sets to what is not made of it; "" if it sets none."""
    to = node.targets[0] if isinstance(node, ast.Assign) else None
    name = to.attr if isinstance(to, ast.Attribute) and text_of(to.value) != "self" else ""
    value = text_of(node.value) if name in _OURS else f".{name}"  # type: ignore[attr-defined]
    return name if f".{name}" not in value or ".get(" in value else ""


def _unmade(repo: HostRepo, module: str) -> Iterator[str]:
    """Folders that a script saves into at any iteration, and makes for some iterations alone."""
    calls = [(each, text_of(each)) for each in every(repo.tree(module), ast.Call)]
    made = "".join(text for _, text in calls if re.match(r"(os\.)?(makedirs|mkdir)\(", text))
    for node, text in ((node, text) for node, text in calls if text.startswith("torch.save(")):
        for name, stem in re.findall(r"((\w+_){\w*})", text):
            if re.search(rf"\b{stem}\d", made) and f"{stem}{{" not in made:
                folder = f"{name}, a folder that it makes for iterations of its own alone"
                yield f"saves into {folder} ({repo.at(module, node.lineno)})"


def _into_none(repo: HostRepo, module: str) -> Iterator[str]:
    """Folders into which a script saves while it trains, and that nothing makes: its author's, or
    one beside its model.
    """
    gone = _perhaps(repo, module)
    whole = "\n".join(map(text_of, reached(repo, [module]).values()))
    made = re.findall(r"(?:makedirs|mkdir\w*)\(.*", whole)
    for function in learning(repo.tree(module)):
        values = {text_of(to): value for to, value in assigned(function)}
        for node in (each for each in every(function, ast.Call) if each not in gone):
            if not re.search(r"(^|\.)save(_image|z|txt)?$", text_of(node.func)):
                continue
            parts = [*node.args]
            for each in parts:  # it grows
                parts += [values.pop(n.id) for n in every(each, ast.Name) if n.id in values]
            texts = [str(n.value) for each in parts for n in every(each, ast.Constant)]
            found = [(each, "of its author's") for each in texts if _AUTHORS.match(each)]
            if any("model_path" in text_of(each) for each in parts):
                own = {name for each in texts for name in re.findall(r"^/(\w+)/", each)}
                own = {name for name in own if not any(name in each for each in made)}
                found += [(each, "that nothing makes") for each in sorted(own - {"point_cloud"})]
            for folder, why in found:
                yield f"saves into {folder}, a folder {why} ({repo.at(module, node.lineno)})"


_AUTHORS = re.compile(r"/(home|Users|mnt|data)/\w")


def _untyped(repo: HostRepo, module: str) -> Iterator[str]:
    """The length of a training, where its default is None: a group makes no type of that."""
    for group in every(repo.tree("arguments"), ast.ClassDef):
        made = repo.function("arguments", f"{group.name}.__init__")
        taken = repo.parameters("arguments", f"{group.name}.__init__") or ()
        calls = repo.calls(module, group.name)
        for value in (value for to, value in assigned(made) if text_of(to) == "self.iterations"):
            name = text_of(value)
            if (
                made
                and name in off_by_default(made)
                and any(name not in passed(e, taken) for e in calls)
            ):
                at = repo.at("arguments", value.lineno)
                yield f"cannot take --iterations, which is None by default ({at})"


def _started(body: Iterable[ast.stmt]) -> Iterator[ast.stmt]:
    """The statements of a script that is started, whatever its command says."""
    for node in body:
        yield node
        if isinstance(node, ast.If) and re.match("__(name|debug)__", text_of(node.test)):
            yield from _started(node.body)


def overruling(repo: HostRepo, module: str) -> frozenset[str]:
    """Options, off by default, under which a script ends early, or sets others or defaults, or
    another checkpoint.
    """
    tree = repo.tree(module)
    named = named_once(tree)
    known = as_options(repo, ("arguments", module), named)
    imports = every(tree, ast.ImportFrom)
    homes = {each.name: repo.absolute(module, node) for node in imports for each in node.names}
    found = frozenset[str]().union(*(asked for _, asked in _ends(repo, module)))
    for node, test in skipped(tree, known).items():
        called = getattr(node, "func", None)
        name = getattr(called, "id", "")
        made = repo.function(homes.get(name, module), name) if name else None
        defaults = getattr(called, "attr", "") == "set_defaults"
        to = text_of(node.targets[0]) if isinstance(node, ast.Assign) else ""
        sets = name == "setattr" or defaults or _overruled(node) or to in _RESUMED
        if sets or (made and _sets_any(made, {})):
            found |= options_of(test, known, named)
    return found


_RESUMED = ("checkpoint", "start_checkpoint")
"""What scripts call the checkpoint that they resume."""


@lru_cache(maxsize=64)  # of the adapters, many ask
def _ends(repo: HostRepo, module: str) -> list[tuple[str, frozenset[str]]]:
    """Where a training ends before its last iteration, by what it measures, and the options, off by
    default, that ask for this.
    """
    tree, modules = repo.tree(module), ("arguments", module)
    named = named_once(tree)
    known, found = as_options(repo, modules, named), []
    loops: tuple[Any, ...] = every(tree, ast.For, ast.While)
    training = (each.body for each in loops if "backward(" in text_of(each))
    for node, tests in (each for body in training for each in _leaving(body)):
        asks = " and ".join(map(text_of, tests))
        if tests and not re.search(r"iterations\b|nan\b|finite", asks):
            read = {name for each in tests for name in options_of(each, known, named)}
            off = {name for name in read if not by_default_of(repo, modules, name)[0]}
            place = f"{text_of(tests[-1])[:60]} ({repo.at(module, node.lineno)})"
            found.append((f"may end before its last iteration, where {place}", frozenset(off)))
    return found


def _by_another(repo: HostRepo, module: str) -> Iterator[str]:
    """Options that say how long a script trains in the place of ``--iterations``."""
    named = named_once(repo.tree(module))
    for function in learning(repo.tree(module)):
        both: tuple[Any, ...] = every(function, ast.For, ast.While)
        loops = sorted((e for e in both if "backward(" in text_of(e)), key=lambda e: e.lineno)
        heads: list[Any] = [e.iter if isinstance(e, ast.For) else e.test for e in loops]
        ends = heads[0].args[:2][-1:] if loops and text_of(heads[0]).startswith("range(") else []
        read = (n.attr for e in _spelled(ends, named) for n in every(e, ast.Attribute))
        known = [name for name in read if by_default_of(repo, ("arguments", module), name)]
        if known and not any("iterations" in text_of(each) for each in _spelled(heads, named)):
            at = repo.at(module, loops[0].lineno)
            yield f"trains as long as --{known[0]} says, not --iterations ({at})"


def _spelled(parts: Iterable[ast.AST], named: Mapping[str, ast.AST]) -> list[ast.AST]:
    """Code and what its names stand for."""
    found = [*parts]
    for each in found:  # it grows
        values = (named[n.id] for n in every(each, ast.Name) if n.id in named)
        found += [value for value in values if value not in found]
    return found


def _leaving(
    body: Iterable[ast.stmt], tests: tuple[ast.expr, ...] = ()
) -> Iterator[tuple[ast.stmt, tuple[ast.expr, ...]]]:
    """What leaves a loop, of its body, and the tests before each."""
    for node in body:
        if isinstance(node, ast.Break | ast.Return) or re.match(r"(sys\.)?exit\(", text_of(node)):
            yield node, tests
        elif not isinstance(node, ast.For | ast.While | ast.FunctionDef):
            asked = (*tests, node.test) if isinstance(node, ast.If) else tests
            for part in ("body", "orelse", "finalbody"):
                yield from _leaving(getattr(node, part, ()), asked)


def named_once(tree: ast.AST | None) -> dict[str, ast.expr]:
    """What a script gives a name, if it gives that once: also the values with which it calls a
    function once, by the names of its parameters.
    """
    once = bindings(tree)
    pairs = [(getattr(to, "id", ""), value) for to, value in assigned(tree)]
    for function in every(tree, ast.FunctionDef):
        calls = [n for n in every(tree, ast.Call) if getattr(n.func, "id", "") == function.name]
        names = [each.arg for each in function.args.args]
        pairs += [*passed(calls[0], names).items()] if len(calls) == 1 else []
    return {name: value for name, value in pairs if once[name] == 1}


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
def bindings(tree: ast.AST | None) -> Counter[str]:
    """How often a module gives something a name."""
    return Counter(named(nodes(tree)))


def named(parts: Iterable[ast.AST]) -> Iterator[str]:
    """The names that code gives, of each part."""
    for node in parts:
        if isinstance(getattr(node, "ctx", ast.Store()), ast.Store):
            kinds = () if isinstance(node, ast.keyword) else ("name", "asname", "arg", "id")
            names = {str(getattr(node, kind, "")) for kind in kinds} | {*getattr(node, "names", ())}
            yield from {each.split(".")[0] for each in names if isinstance(each, str)}


def misfit(called: ast.AST | None, call: ast.Call, of_model: bool) -> str:
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
