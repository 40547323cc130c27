"""Is the PLY that a codebase saves a plain 3DGS model? Read from its source, without an import.

It is if it has the columns of 3DGS and no others that change the picture, if the values are saved
before activation, and if ``render`` draws from the model's getters alone.
"""

from __future__ import annotations

import ast
import re
from collections.abc import Iterable, Iterator
from dataclasses import replace
from functools import lru_cache

from fragprune_graphdeco import failing, reading, saved
from fragprune_graphdeco.call import RASTERIZER
from fragprune_graphdeco.drawing import Drawing, arguments, drawing_in
from fragprune_graphdeco.kernels import DISTANCE, ORDER, SPLAT, read_kernels
from fragprune_graphdeco.photographs import unlike
from fragprune_graphdeco.reading import ModelClass, mentions
from fragprune_graphdeco.syntax import assigned, every, is_off, off_by_default, passed, text_of
from fragprune_plugins.adapting import HostRepo, Plain, change_of, nodes

_DEEPEST = 3  # folders below a checkout in which codebases are looked for
SAVES = re.compile(r"\.save_ply\w*\(|scene\w*\.save\(")
_ABSENT = "no model of this family that saves a PLY was found"
_UNSAVED = "none of its scripts saves a PLY"


def read_models(repo: HostRepo) -> list[Plain]:
    """``read_plain`` of a checkout, and of the codebases of this family in its folders."""
    patterns = ("*/" * deep + "gaussian_renderer" for deep in range(1, _DEEPEST + 1))
    found = (path.parent for each in patterns for path in repo.root.glob(each) if path.is_dir())
    names = (each.relative_to(repo.root).as_posix() for each in sorted(found))
    saves = any(map(SAVES.search, reading.texts_of(repo).values()))  # also what is in a folder
    own, models = read_plain(repo), []
    for each in (name for name in names if "/." not in f"/{name}"):
        model = read_plain(HostRepo(repo.root / each))
        reasons = [why for why in model.reasons if not saves or why != _UNSAVED]
        reasons += dict(_moved(HostRepo(repo.root / each), repo))
        if reasons != [*model.reasons] and not reasons:  # what trains it lies above its folder
            model = replace(model, unlike=unlike(repo, reading.training_modules(repo)))
        models.append(replace(model, folder=each, reasons=tuple(reasons)))
    beside = not _own_renderers(repo) and any(each.model for each in models)
    if beside:  # what was found by itself is that of a folder
        own = Plain(own.reasons or (_ABSENT,))
    return [own, *models]


@lru_cache(maxsize=16)
def read_plain(repo: HostRepo) -> Plain:
    """Read a checkout's model, its save function, its drawing function and its kernel, once."""
    model = next(_models(repo), None)
    if model is None:
        return Plain((*dict(_of_drawing(repo, _own_renderers(repo))), _without(repo)))
    flat, getters = list(saved.scales(model)), dict(saved.getters(model))
    drawn = dict([*_of_drawing(repo, _renderers(repo)), *_moved(repo, repo)])
    reasons = [
        *saved.elements(model),
        *flat,
        *(each for each in drawn if "3D_filter" not in each),
        *getters,
        *_of_columns(model),
        *(() if flat else _of_kernel(repo)),
        *failing.unlike_3dgs(repo),
        *drawn,
        *saved.values(model),
        *saved.activations(model),
        *saved.positions(model),
        *_of_others(model),
        *_of_scripts(model),
    ]
    moved = frozenset(each for each, moves in (drawn | getters).items() if moves)
    elsewhere = "" if model.module == reading.MODEL else f"{model.name} is in {model.module}"
    differs = unlike(repo, reading.training_modules(repo)) if not reasons else ""
    return Plain(tuple(dict.fromkeys(reasons)), model.name, moved, "", elsewhere, differs)


def _without(repo: HostRepo) -> str:
    """Why no model was found that saves a PLY."""
    model = ModelClass(repo)
    if repo.path(model.module) and repo.tree(model.module) is None:
        return "its scene/gaussian_model.py is no valid Python"
    if model.method("__init__"):
        return f"its GaussianModel has no save_ply ({repo.place(model.module, model.name)})"
    paths = re.findall(r"^\s*path = (\S+)", repo.read(repo.root / ".gitmodules"), re.MULTILINE)
    absent = [each for each in paths if not any((repo.root / each).glob("*"))]
    beside = f"; its submodules are not in the checkout: {', '.join(absent)}" if absent else ""
    return f"{_ABSENT}{beside}"


def _models(repo: HostRepo) -> Iterator[ModelClass]:
    """The models that save a PLY, the one that ``scene`` exports first: those in ``scene``, or else
    those that a script trains.
    """
    home = reading.home_of(repo, "scene").removeprefix("scene.")
    stems = [each.stem for each in (repo.root / "scene").glob("*.py") if each.stem.isidentifier()]
    stems.sort(key=lambda s: (s != home, "gaussian" not in s, "model" not in s, len(s), s))
    found = [*_saving(repo, [f"scene.{each}" for each in stems], "save_ply")]
    trained = _trained(repo) if not found else []
    setups = [*_saving(repo, trained, "save_ply", "training_setup")]
    yield from found or setups or _saving(repo, trained, "save_ply", "get_xyz")


def _saving(repo: HostRepo, modules: Iterable[str], *methods: str) -> Iterator[ModelClass]:
    """Each class with these methods that lists the columns of a PLY."""
    for module in modules:
        body = getattr(repo.tree(module), "body", ())
        classes = [each for each in body if isinstance(each, ast.ClassDef)]
        for each in sorted(classes, key=lambda each: each.name != "GaussianModel"):
            own = {getattr(node, "name", "") for node in each.body}
            model = ModelClass(repo, module, each.name)
            if own.issuperset(methods) and saved.columns(model)[1]:
                yield model


def _trained(repo: HostRepo) -> list[str]:
    """The training scripts and what they import of a codebase."""
    deeper = [f"{path.parent.name}.{path.stem}" for path in sorted(repo.root.glob("*/*train*.py"))]
    others = (each.stem for each in sorted(repo.root.glob("*.py")))
    return [*reading.reached(repo, [*reading.training_modules(repo), *deeper] or others)]


def _of_others(model: ModelClass) -> Iterator[str]:
    """Other models that training scripts make, if none makes the model alone, with columns that
    change the picture.
    """
    repo, scripts = model.repo, reading.training_modules(model.repo)
    with_model = [each for each in scripts if mentions(repo, [each], [model.name])]
    for other in _models(repo):
        differs = other.name != model.name
        alone = differs and any(not mentions(repo, [each], [other.name]) for each in with_model)
        if other.module == model.module or alone or not mentions(repo, scripts, [other.name]):
            continue
        trained, names = f"{other.name}, which a script here trains:", saved.columns(other)[1]
        whole = all(any(each.startswith(column) for each in names) for column in saved.COLUMNS)
        for each in (name for name in names if name not in saved.PLAIN):
            says = change_of(each)
            if says or whole:  # if not whole, it is no model that makes a picture
                what, at = f"{each}, {says}" if says else each, other.at(saved.LISTS)
                yield f"{trained} its PLY also holds {what} ({at})"
        if whole:
            for reason in (
                *saved.values(other),
                *saved.activations(other),
                *dict(saved.getters(other)),
            ):
                yield f"{trained} {reason}"


def _of_columns(model: ModelClass) -> Iterator[str]:
    """Columns that are missing, or that plain 3DGS does not have."""
    (listed, names), at = saved.columns(model), model.at(saved.LISTS)
    if missing := [each for each in saved.COLUMNS if not any(n.startswith(each) for n in names)]:
        yield f"its PLY lacks the columns {', '.join(missing)} ({at})"
    if listed not in (None, model.saver):
        for each in names:
            if (says := change_of(each)) and each not in _seen(model.repo):
                yield f"its PLY also holds {each}, {says} ({at})"


def _seen(repo: HostRepo) -> set[str]:
    """Masks that a rasterizer takes and gives a picture of, beside that of the colours."""
    drawing = (each for module in _renderers(repo)[:1] for each in drawing_in(repo, module)[:1])
    pairs = [(to, value) for each in drawing for to, value in assigned(each)]
    calls = [(text_of(to), value) for to, value in pairs if arguments(value).keys() & {"mask"}]
    return {"mask" for to, _ in calls if re.search(r"\w+_mask\b", to)}


def _of_scripts(model: ModelClass) -> Iterator[str]:
    """No function that draws; scripts of which none saves a PLY, that add several pictures up, or
    of which each makes another model in place of the one that was read.
    """
    repo, scripts = model.repo, reading.training_modules(model.repo)
    if not any(drawing_in(repo, module) for module in _renderers(repo)):
        found = "no function was found that calls a rasterizer of 3DGS"
        yield f"what draws its PLY was not read: {found}"
    if any(repo.root.glob("*.py")) and not any(map(SAVES.search, reading.texts_of(repo).values())):
        yield _UNSAVED
    for script in scripts:
        yield from _of_sums(repo, script)
        for each in every(repo.tree(script), ast.ClassDef):
            own = {getattr(node, "name", "") for node in each.body}
            changed = own & {"setup_functions", *(f"get_{kind}" for kind in reading.GETTERS)}
            if changed and model.name in map(text_of, each.bases):
                at = repo.at(script, each.lineno)
                yield f"its PLY was not read: {each.name} changes {', '.join(changed)} ({at})"
    made = {each: name for each in scripts for name in reading.made_models(repo, each)}
    if made and model.method("get_xyz") and not mentions(repo, scripts, [model.name]):
        script, name = next(iter(made.items()))
        yield f"its PLY was not read: {script}.py trains {name}, not {model.name}"


def _of_sums(repo: HostRepo, script: str) -> Iterator[str]:
    """A picture that a training script adds up of several drawings, or puts together of them."""
    tree = repo.tree(script)
    drawn = {text_of(e) for e in every(tree, ast.Subscript) if text_of(e.slice) == "'render'"}
    pairs = [(text_of(to), made) for to, made in assigned(tree)]
    same = {to: text for to, made in pairs if (text := text_of(_same(made))) != to}
    for put in every(tree, ast.Assign):
        items = [e for e in (put.targets[0], put.value) if isinstance(e, ast.Subscript)]
        names = [text_of(each.value) for each in items]
        of = {each if same.get(each) in drawn else same.get(each, "") for each in names}
        if len(of) == 2 and all(same.get(each) in drawn for each in of):
            at = repo.at(script, put.lineno)
            yield f"its script puts a picture into another, {text_of(put)[:60]} ({at})"
            return
    drawn |= {to for to, made in pairs if text_of(made) in drawn}
    for node in every(tree, ast.BinOp):
        if isinstance(node.op, ast.Add):
            sides = [_terms(each) & drawn for each in (node.left, node.right)]
            if all(sides) and sides[0] != sides[1]:
                at = repo.at(script, node.lineno)
                yield f"its script adds several pictures, {text_of(node)[:60]} ({at})"
                return


def _same(node: ast.expr) -> ast.expr:
    """What a value is made of by methods that keep its numbers."""
    method = getattr(node, "func", None)
    if isinstance(method, ast.Attribute) and method.attr in saved.SAME:
        return _same(method.value)
    return node


def _terms(node: ast.expr) -> set[str]:
    """The names that a sum or product is made of, without those in calls."""
    if isinstance(node, ast.BinOp):
        return _terms(node.left) | _terms(node.right)
    return {text_of(node)}


def _of_kernel(repo: HostRepo) -> Iterator[str]:
    """Differences of vendored rasterizers that the drawing functions import."""
    for module in _renderers(repo):
        for node in nodes(repo.tree(module)):
            if isinstance(node, ast.ImportFrom) and any(RASTERIZER in a.name for a in node.names):
                for finding in read_kernels(repo, repo.absolute(module, node), SPLAT):
                    if finding.level == "error" and finding.code not in (ORDER, DISTANCE):
                        yield f"its rasterizer draws otherwise: {finding.found}, {finding.where}"


def _renderers(repo: HostRepo) -> list[str]:
    """Modules of the drawing functions: those of ``gaussian_renderer``, or else what training
    scripts import.
    """
    return _own_renderers(repo) or [each for each in _trained(repo) if drawing_in(repo, each)]


def _own_renderers(repo: HostRepo) -> list[str]:
    """The modules of ``gaussian_renderer``."""
    own = "gaussian_renderer"
    stems = sorted({each.stem for each in (repo.root / own).glob("*.py")} - {"__init__"})
    return [own] * (repo.path(own) is not None) + [f"{own}.{each}" for each in stems]


def _of_drawing(repo: HostRepo, modules: Iterable[str]) -> Iterator[tuple[str, bool]]:
    """Inputs of the rasterizer that are not the model's own, and whether they only move it.

    Those of ``render``, and of a relative by which training scripts draw in its place.
    """
    for module in modules:
        functions = drawing_in(repo, module)
        named = mentions(repo, reading.training_modules(repo), [each.name for each in functions])
        instead = [n for n in functions[1:] if n.name in named and "render" not in named]
        for function in [*functions[:1], *instead[:1]]:
            yield from Drawing(repo, module, function).reasons()
        if functions:
            return


def _moved(repo: HostRepo, callers: HostRepo) -> Iterator[tuple[str, bool]]:
    """What ``render`` makes of arguments which are off, but which files of a folder give, and
    whether its rows are drawn all the same.
    """
    texts = reading.texts_of(callers).items()
    for module, function in ((m, f) for m in _renderers(repo)[:1] for f in drawing_in(repo, m)[:1]):
        paths = [path for path, text in texts if f"{function.name}(" in text]
        names = [reading.module_of(each.relative_to(callers.root).as_posix()) for each in paths]
        calls = [call for each in names for call in callers.calls(each, function.name)]
        takes = [each.arg for each in function.args.args]
        words = [pair for call in calls for pair in passed(call, takes).items()]
        asked = {value: getattr(value, "attr", "") for _, value in words}
        of = [(repo, ("arguments",)), (callers, names)]
        off = {e for e, name in asked.items() if any(reading.off_in(*at, name) for at in of)}
        given = {name for name, value in words if not (is_off(value) or value in off)}
        given &= off_by_default(function)
        usual = dict(Drawing(repo, module, function).inputs()) if given else {}
        made = rf"from ([\w.]+, )*({'|'.join(sorted(given))})(,| \()|(?<!colours) from \w+\.get_"
        for why, kept in Drawing(repo, module, function, on=given).inputs() if given else ():
            if why not in usual and re.search(made, why):
                yield why, kept
