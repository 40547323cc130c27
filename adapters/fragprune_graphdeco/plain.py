"""Is the PLY that a codebase saves a plain 3DGS model? Read from its source, without an import.

It is if it has the columns of 3DGS and no others that change the picture, if the values are saved
before activation, and if ``render`` draws from the model's getters alone.
"""

from __future__ import annotations

import ast
import re
from collections.abc import Collection, Iterable, Iterator, Mapping
from dataclasses import replace
from functools import lru_cache
from pathlib import Path

from fragprune_graphdeco import reading
from fragprune_graphdeco.call import ARGUMENTS, RASTERIZER, read_calls
from fragprune_graphdeco.kernels import ORDER, SPLAT, read_kernels
from fragprune_graphdeco.photographs import unlike
from fragprune_graphdeco.reading import ModelClass, assigned, every, first_of, passed, text_of
from fragprune_plugins.adapting import (
    Function,
    HostRepo,
    Plain,
    change_of,
    is_off,
    nodes,
    off_by_default,
)

_DEEPEST = 3  # folders below a checkout in which codebases are looked for
_COLUMNS = ("f_dc", "f_rest", "opacity", "scale", "rot")
_PLAIN = {"x", "y", "z", "nx", "ny", "nz", "l", *_COLUMNS}
_OF_MODEL = re.compile(
    r"get_(xyz|opacity|scaling|rotation|features\w*|covariance)|_(xyz|opacity|scaling|rotation|"
    r"features_dc|features_rest)|\w+_activation|\w*sh_degree|get_max_sh_channels|screenspace_points"
)
"""Attributes of the model that a plain drawing reads."""
_OF_CALL = re.compile(
    r"view\w*|cam\w*|\w*pose\w*|pipe\w*|scal\w*|override_color|\w*mask\w*|bg\w*|xyz|means3D|"
    r"opacity|opacities|features|shs|dc|rotations?|\w*sh\w*|iteration|drop\w*"
)
"""Parameters of a drawing function that move or select Gaussians, are their values, or say how far
training is, as where it leaves some out."""
_SAME = {
    *("clone", "contiguous", "cuda", "detach", "expand", "float", "permute", "repeat", "reshape"),
    *("squeeze", "to", "unsqueeze", "view"),
}
"""Methods that keep numbers."""
_KEEPS = {*_SAME, "clamp", "clamp_"}
"""Methods that keep the numbers of a picture."""
_STORES = {*_SAME, "astype", "cpu", "flatten", "numpy", "transpose"}
"""Methods that keep the numbers of a PLY."""
_ACTIVATING = {each for names in reading.ACTIVATIONS.values() for each in names}
_ADDED = re.compile(r"bg_color|zeros_like\(\w+\)$|\* 0\.0$")
"""What is added to a picture and leaves its Gaussians alone: a background, or zeros."""
_PICTURES = re.compile(r"mesh_\w+|(?!clamp|use)\w+_(rgb|colou?rs?)")
"""Arguments of a rasterizer that are pictures to blend with its own."""
_CHANNELS = re.compile(r"feat|sem|lang|obj|mask|label|normal")
"""In names of values that a rasterizer blends beside the colours."""
_OTHERS = re.compile(r"^(?!num_|.*(depth|normal|alpha)).*(image|render|rgb|colou?r)")
"""Names of other pictures that a rasterizer may return before its own."""
_RASTERIZER = re.compile(r"(self\.)?\w*rasterizer")
"""What drawing functions call a rasterizer that they made."""
_GSPLAT = {
    **{"means": "means3D", "quats": "rotations", "scales": "scales"},
    **{"opacities": "opacities", "colors": "colors_precomp"},
}
"""Arguments of gsplat's ``rasterization`` in order, by their names in 3DGS."""
_CLAMPED = re.compile(
    r"(?:(?:torch|F)\.(?:clamp|clamp_min|relu))?\((.+) \+ 0\.5"
    r"(?:, |\)\.(?:clamp|clamp_min|relu)\()?(?:min=)?(?:0|0\.0)?\)"
)
"""How harmonics become colours."""
_USUAL = {
    **{"rasterize_mode": "classic", "camera_model": "pinhole", "eps2d": 0.3},
    "scale_modifier": 1.0,  # a setting of the rasterizers of 3DGS
}
"""Arguments of it that change the picture, and the values with which it draws as 3DGS does."""
_SAVES = re.compile(r"\.save_ply\w*\(|scene\w*\.save\(")
_LISTS = "construct_list_of_attributes"
_ABSENT = "no model of this family that saves a PLY was found"
_UNSAVED = "none of its scripts saves a PLY"


def read_models(repo: HostRepo) -> list[Plain]:
    """``read_plain`` of a checkout, and of the codebases of this family in its folders."""
    patterns = ("*/" * deep + "gaussian_renderer" for deep in range(1, _DEEPEST + 1))
    found = (path.parent for each in patterns for path in repo.root.glob(each) if path.is_dir())
    names = (each.relative_to(repo.root).as_posix() for each in sorted(found))
    saved = any(map(_SAVES.search, _scripts(repo).values()))  # also what is in a folder
    own, models = read_plain(repo), []
    for each in (name for name in names if "/." not in f"/{name}"):
        model = read_plain(HostRepo(repo.root / each))
        reasons = [why for why in model.reasons if not saved or why != _UNSAVED]
        reasons += dict(_moved(HostRepo(repo.root / each), repo))
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
    flat, getters = list(_scales(model)), dict(_of_getters(model))
    drawn = dict([*_of_drawing(repo, _renderers(repo)), *_moved(repo, repo)])
    reasons = [
        *flat,
        *(each for each in drawn if "3D_filter" not in each),
        *getters,
        *_of_columns(model),
        *(() if flat else _of_kernel(repo)),
        *drawn,
        *_of_saving(model),
        *_of_activations(model),
        *_of_positions(model),
        *_of_others(model),
        *_of_scripts(model),
    ]
    moved = frozenset(each for each, moves in (drawn | getters).items() if moves)
    elsewhere = "" if model.module == reading.MODEL else f"{model.name} is in {model.module}"
    differs = unlike(repo, _training(repo)) if not reasons else ""
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
            if own.issuperset(methods) and _columns(model)[1]:
                yield model


def _trained(repo: HostRepo) -> list[str]:
    """The training scripts and what they import of a codebase."""
    deeper = [f"{path.parent.name}.{path.stem}" for path in sorted(repo.root.glob("*/*train*.py"))]
    others = (each.stem for each in sorted(repo.root.glob("*.py")))
    return [*reading.reached(repo, [*_training(repo), *deeper] or others)]


def _of_others(model: ModelClass) -> Iterator[str]:
    """Other models that training scripts make, if none makes the model alone, with columns that
    change the picture.
    """
    repo, scripts = model.repo, _training(model.repo)
    with_model = [each for each in scripts if repo.mentions([each], [model.name])]
    for other in _models(repo):
        differs = other.name != model.name
        alone = differs and any(not repo.mentions([each], [other.name]) for each in with_model)
        if other.module == model.module or alone or not repo.mentions(scripts, [other.name]):
            continue
        trained, names = f"{other.name}, which a script here trains:", _columns(other)[1]
        whole = all(any(each.startswith(column) for each in names) for column in _COLUMNS)
        for each in (name for name in names if name not in _PLAIN):
            says = change_of(each)
            if says or whole:  # if not whole, it is no model that makes a picture
                what, at = f"{each}, {says}" if says else each, other.at(_LISTS)
                yield f"{trained} its PLY also holds {what} ({at})"
        if whole:
            for reason in (*_of_saving(other), *_of_activations(other), *dict(_of_getters(other))):
                yield f"{trained} {reason}"


def _columns(model: ModelClass) -> tuple[Function | None, list[str]]:
    """The function that lists a PLY's columns, and their names without numbers."""
    listed = model.method(_LISTS) or model.saver
    names = dict.fromkeys(
        re.sub(r"_?(\{\})?\d*$", "", node.value)
        for node in every(listed, ast.Constant)
        if isinstance(node.value, str)
    )
    return listed, [each for each in names if each.isidentifier()]


def _of_columns(model: ModelClass) -> Iterator[str]:
    """Columns that are missing, or that plain 3DGS does not have."""
    (listed, names), at = _columns(model), model.at(_LISTS)
    if missing := [each for each in _COLUMNS if not any(n.startswith(each) for n in names)]:
        yield f"its PLY lacks the columns {', '.join(missing)} ({at})"
    if listed is not None and listed.name == _LISTS:
        for each in names:
            if (says := change_of(each)) and each not in _seen(model.repo):
                yield f"its PLY also holds {each}, {says} ({at})"


def _seen(repo: HostRepo) -> set[str]:
    """Masks that a rasterizer takes and gives a picture of, beside that of the colours."""
    drawing = (each for module in _renderers(repo)[:1] for each in _drawing(repo, module)[:1])
    pairs = [(to, value) for each in drawing for to, value in assigned(each)]
    calls = [(text_of(to), value) for to, value in pairs if arguments(value).keys() & {"mask"}]
    return {"mask" for to, _ in calls if re.search(r"\w+_mask\b", to)}


def _scales(model: ModelClass) -> Iterator[str]:
    """Gaussians with two scales, or with one."""
    repo, module = model.repo, model.module
    setup = every(model.method("create_from_pcd"), ast.Assign)
    joined = " ".join(re.findall(r"\bcat\([\[(](.*?)[\])]", " ".join(map(text_of, setup))))
    for each in every(repo.definition(module, model.name), ast.Assign):
        wide = re.search(r"\.repeat\(1, ([12])\)( if .*)?$", text_of(each.value))
        target = text_of(each.targets[0])
        if wide and target not in joined and (each in setup or "scal" in target):
            what = "flat, with two scales" if wide[1] == "2" else "round, with one scale"
            yield f"its Gaussians are {what} ({repo.at(module, each.lineno)})"
            return
    stored = [each.value for each in setup if text_of(each.targets[0]) == "self._scaling"]
    names = {node.id for each in stored for node in every(each, ast.Name)}
    made = [each for each in setup if getattr(each.targets[0], "id", "") in names]
    if made and all(text_of(each.value).endswith("[..., None]") for each in made):
        yield f"its Gaussians are round, with one scale ({repo.at(module, made[0].lineno)})"


def _of_saving(model: ModelClass) -> Iterator[str]:
    """Values that are not saved as they are before activation."""
    repo, module = model.repo, model.module
    for node in _assigned_names(model.saver):
        target, value = text_of(node.targets[0]), text_of(node.value)
        shown = f"{value[:60]} ({repo.at(module, node.lineno)})"
        taken = any(_takes(node, kind) for kind in ("scaling", "opacity"))
        if taken and not re.search(r"inverse|log", value):
            yield f"save_ply stores activated values, {target} = {shown}"
        if target in ("opacities", "scale") and (got := re.match(r"self\.(get_\w+_\w+)", value)):
            getter, stored = model.method(got[1]), "_scaling" if target == "scale" else "_opacity"
            if getter is None or reading.returns(getter, stored) != {"stored"}:
                yield f"save_ply stores other values, {target} = {shown}"
        if target in ("xyz", "f_dc", "f_rest", "opacities", "scale", "rotation"):
            if re.match(r"np\.(zeros|ones)", value):
                yield f"save_ply stores no {target}: {shown}"
            elif _other_numbers(node.value):
                yield f"save_ply stores other numbers, {target} = {shown}"
    for each in _stored(model.saver):
        if _other_numbers(each):
            shown = f"{text_of(each)[:60]} ({repo.at(module, each.lineno)})"
            yield f"save_ply stores other numbers, {shown}"


def _other_numbers(value: ast.expr) -> bool:
    """Whether code makes other numbers of the parameters that a PLY is to have."""
    method = getattr(value, "func", None)
    if isinstance(value, ast.Subscript) and not every(value.slice, ast.List):
        return _other_numbers(value.value)
    if isinstance(method, ast.Attribute) and method.attr in _STORES:
        return _other_numbers(method.value)
    known = re.search(r"inverse|log|gather|np\.(zeros|ones)", text_of(method))
    return not (known or isinstance(value, ast.Name | ast.Attribute))


def _assigned_names(save: Function | None) -> list[ast.Assign]:
    """What a function assigns to variables."""
    return [each for each in every(save, ast.Assign) if isinstance(each.targets[0], ast.Name)]


def _takes(node: ast.Assign, kind: str) -> bool:
    """Whether a value is made of what a getter activates, and not only compared with it."""
    found = re.search(rf"self\.get_{kind}\b", text_of(node.value))
    return bool(found) and not isinstance(node.value, ast.Compare)


def _of_activations(model: ModelClass) -> Iterator[str]:
    """Other activations than those of 3DGS, wherever they are set, and getters that are replaced.

    What is saved activated needs none.
    """
    repo, module = model.repo, model.module
    saved = _assigned_names(model.saver)
    text = "".join([text_of(repo.tree(module)), *_scripts(repo).values()])
    functions = every(repo.tree(module), ast.FunctionDef)
    used = ("__init__", "setup_functions")
    made_of = [e for e in functions if e.name in used or f".{e.name}(" in text]
    own = [e for e in getattr(repo.tree(module), "body", ()) if isinstance(e, ast.Assign)]
    places: list[tuple[str, ast.AST]] = [(module, each) for each in (*made_of, *own)]
    places += [(each, tree) for each in _training(repo) if (tree := repo.tree(each))]
    for place, part in places:
        for to, made in assigned(part):
            attribute, value = getattr(to, "attr", ""), text_of(made)
            expected = reading.ACTIVATIONS.get(attribute, (value,))
            kind = attribute.removesuffix("_activation")
            if value not in expected and not any(_takes(each, kind) for each in saved):
                yield f"its {attribute} is {value[:50]} ({repo.at(place, to.lineno)})"
            if re.fullmatch(rf"{model.name}\.get_\w+", text_of(to)):
                yield f"{text_of(to)} is replaced ({repo.at(place, to.lineno)})"
    for attribute in reading.ACTIVATIONS:
        if model.method(attribute):
            yield f"its {attribute} is a method ({model.at(attribute)})"


def _stored(save: Function | None) -> list[ast.expr]:
    """What a function puts side by side into the columns of a PLY."""
    joined = (each for each in every(save, ast.Call) if text_of(each.func) == "np.concatenate")
    given = [each.args[0] for each in joined if each.args]
    return [each for whole in given for each in getattr(whole, "elts", ())]


def _of_getters(model: ModelClass) -> Iterator[tuple[str, bool]]:
    """Getters of other values than the PLY's; true if only where an attribute was set later."""
    saved = text_of(model.saver)
    if model.method("get_xyz") is None:  # a class that only saves
        model = ModelClass(model.repo)
    always = reading.computed_getters(model, reading.unset(model))
    options = reading.options(model, _training(model.repo))
    home = reading.class_of(model)
    bases = [text_of(each) for each in getattr(home, "bases", ())]
    if {*bases} - {"object", "nn.Module", "torch.nn.Module"} and model.method("get_xyz"):
        for kind in (kind for kind, getter in model.getters.items() if getter is None):
            yield f"get_{kind} is that of {', '.join(bases)}, which was not read", False
    for kind in reading.computed_getters(model, options):
        if kind != "xyz" or "self.get_xyz" not in saved:
            yield f"get_{kind} is computed ({model.at(f'get_{kind}')})", kind not in always


def _of_covariances(model: ModelClass) -> Iterator[str]:
    """Covariances to which something is added."""
    for each in every(model.repo.definition(model.module, model.name), ast.FunctionDef):
        added = re.search(r".* [+-]=? .*", text_of(each))
        if added and re.fullmatch(r"(get|build)_covariance(_from\w+)?", each.name):
            at = model.repo.at(model.module, each.lineno)
            yield f"{each.name} makes other covariances, {added[0].strip()[:60]} ({at})"


def _of_positions(model: ModelClass) -> Iterator[str]:
    """Positions that no optimizer moves: something else makes them for every picture."""
    setup, created = model.method("training_setup"), text_of(model.method("create_from_pcd"))
    trained = " ".join(map(text_of, reading.entries(setup, "params")))
    fixed = re.search(r"self\._xyz = .*requires_grad_\(False\)", created)
    if "self._opacity" in trained and not (fixed or re.search(r"self\._xyz\b", trained)):
        at = model.at("training_setup")
        yield f"its optimizer does not train positions, which are made otherwise ({at})"


def _of_scripts(model: ModelClass) -> Iterator[str]:
    """No function that draws; scripts of which none saves a PLY, that add several pictures up, or
    of which each makes another model in place of the one that was read.
    """
    repo, scripts = model.repo, _training(model.repo)
    if not any(_drawing(repo, module) for module in _renderers(repo)):
        found = "no function was found that calls a rasterizer of 3DGS"
        yield f"what draws its PLY was not read: {found}"
    if any(repo.root.glob("*.py")) and not any(map(_SAVES.search, _scripts(repo).values())):
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
    if made and model.method("get_xyz") and not repo.mentions(scripts, [model.name]):
        script, name = next(iter(made.items()))
        yield f"its PLY was not read: {script}.py trains {name}, not {model.name}"


def _of_sums(repo: HostRepo, script: str) -> Iterator[str]:
    """A picture that a training script adds up of several drawings."""
    tree = repo.tree(script)
    parts = ((to, made) for to, made in assigned(tree) if isinstance(made, ast.Subscript))
    drawn = {text_of(to) for to, made in parts if text_of(made.slice) == "'render'"}
    drawn |= {text_of(e) for e in every(tree, ast.Subscript) if text_of(e.slice) == "'render'"}
    for node in every(tree, ast.BinOp):
        if isinstance(node.op, ast.Add):
            sides = [_terms(each) & drawn for each in (node.left, node.right)]
            if all(sides) and sides[0] != sides[1]:
                at = repo.at(script, node.lineno)
                yield f"its script adds several pictures, {text_of(node)[:60]} ({at})"
                return


def _terms(node: ast.expr) -> set[str]:
    """The names that a sum or product is made of, without those in calls."""
    if isinstance(node, ast.BinOp):
        return _terms(node.left) | _terms(node.right)
    return {text_of(node)}


def _training(repo: HostRepo) -> list[str]:
    """Modules of the scripts that train, by their names, or else by what they do."""
    named = sorted(each.stem for each in repo.root.glob("*train*.py") if each.stem.isidentifier())
    return named or [*map(reading.module_of, reading.training_scripts(repo))]


@lru_cache(maxsize=16)
def _scripts(repo: HostRepo) -> dict[Path, str]:
    """The files of a codebase that may draw or save its model, with their text."""
    paths = [path for each in ("", "*/", "*/*/") for path in sorted(repo.root.glob(f"{each}*.py"))]
    texts = {each: repo.read(each) for each in paths}
    return {k: v for k, v in texts.items() if k.parent.name != "scene" or "def save" not in v}


def _of_kernel(repo: HostRepo) -> Iterator[str]:
    """Differences of vendored rasterizers that the drawing functions import."""
    for module in _renderers(repo):
        for node in nodes(repo.tree(module)):
            if isinstance(node, ast.ImportFrom) and any(RASTERIZER in a.name for a in node.names):
                for finding in read_kernels(repo, repo.absolute(module, node), SPLAT):
                    if finding.level == "error" and finding.code != ORDER:
                        yield f"its rasterizer draws otherwise: {finding.found}, {finding.where}"


def _renderers(repo: HostRepo) -> list[str]:
    """Modules of the drawing functions: those of ``gaussian_renderer``, or else what training
    scripts import.
    """
    return _own_renderers(repo) or [each for each in _trained(repo) if _drawing(repo, each)]


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
        functions = _drawing(repo, module)
        named = repo.mentions(_training(repo), [each.name for each in functions])
        instead = [n for n in functions[1:] if n.name in named and "render" not in named]
        for function in [*functions[:1], *instead[:1]]:
            yield from Drawing(repo, module, function).reasons()
        if functions:
            return


def _moved(repo: HostRepo, callers: HostRepo) -> Iterator[tuple[str, bool]]:
    """Shapes that ``render`` makes of arguments which are off, but which files of a folder give,
    and whether its rows are drawn all the same.
    """
    texts = _scripts(callers).items()
    for module, function in ((m, f) for m in _renderers(repo)[:1] for f in _drawing(repo, m)[:1]):
        paths = [path for path, text in texts if f"{function.name}(" in text]
        names = (reading.module_of(each.relative_to(callers.root).as_posix()) for each in paths)
        calls = [call for each in names for call in callers.calls(each, function.name)]
        takes = [each.arg for each in function.args.args]
        words = [pair for call in calls for pair in passed(call, takes).items()]
        given = {name for name, value in words if not is_off(value)} & off_by_default(function)
        for why, kept in Drawing(repo, module, function, on=given).shapes() if given else ():
            if re.search(rf"from ([\w.]+, )*({'|'.join(sorted(given))}),", why):
                yield why, kept


def _drawing(repo: HostRepo, module: str) -> list[ast.FunctionDef]:
    """The functions of a module that draw, ``render`` first, then those that return a picture."""
    body = getattr(repo.tree(module), "body", ())
    last = {each.name: each for each in body if isinstance(each, ast.FunctionDef)}
    found = [each for each in last.values() if _call(each)]
    return sorted(found, key=lambda each: (each.name != "render", not pictures(each)))


def _call(function: ast.AST, known: reading.Known = lambda _: []) -> ast.Call | None:
    """The call that draws, of several one whose picture is returned, and that is made by the values
    that are known.
    """
    shown, gone = _shown(function), reading.skipped(function, known)
    calls = [node for node in every(function, ast.Call) if "means3D" in arguments(node)]
    order = {each: (each not in shown, each in gone, each.lineno) for each in calls}
    return min(order, key=order.__getitem__, default=None)


def arguments(call: ast.AST | None) -> dict[str, ast.expr]:
    """The arguments of a call, by their names in a rasterizer of 3DGS."""
    if not isinstance(call, ast.Call):
        return {}
    given = passed(call, ())
    if text_of(call.func).split(".")[-1] == "rasterization":
        return {_GSPLAT.get(name, name): value for name, value in passed(call, _GSPLAT).items()}
    drawn = "opacities" in given or _RASTERIZER.fullmatch(text_of(call.func))
    return passed(call, ARGUMENTS) if drawn else given


def pictures(function: ast.AST) -> list[ast.expr]:
    """What a function returns as ``render``."""
    later = (v for to, v in assigned(function) if text_of(getattr(to, "slice", None)) == "'render'")
    return [*reading.entries(function, "render"), *later]


def _shown(function: ast.AST) -> list[ast.AST]:
    """The code that makes what a function returns as ``render``."""
    made: dict[str, list[ast.expr]] = {}
    for target, value in assigned(function):
        made.setdefault(getattr(first_of(target), "id", ""), []).append(value)
    found: list[ast.AST] = [*pictures(function)]
    for each in found:  # it grows
        if isinstance(each, ast.Name):
            found += made.pop(each.id, [])
        elif "means3D" not in arguments(each):
            found += ast.iter_child_nodes(each)
    return found


def _cuts(node: ast.Subscript) -> bool:
    """Whether code takes some or reorders some of what it reads, but for the first 3 channels."""
    parts = node.slice.elts if isinstance(node.slice, ast.Tuple) else [node.slice]
    cut = [each for each in parts if text_of(each) not in (":", ":3", "0:3")]
    return any(isinstance(each, ast.Slice | ast.List) for each in cut)


def _never_set(repo: HostRepo, value: str) -> bool:
    """Whether a value is an attribute that may be missing, and that no file sets."""
    asked = re.fullmatch(r"getattr\(\w+, '(\w+)', None\)", value)
    if asked is None:
        return False
    model = (repo.read(each) for each in (repo.root / "scene").glob("*.py"))
    text = "".join((*model, *_scripts(repo).values()))
    text = re.sub(rf"getattr\(\w+,\s*['\"]{asked[1]}['\"]", "", text)
    return not re.search(rf"['\"]{asked[1]}['\"]|\.{asked[1]}\s*(:[^=\n]+)?=(?!=)", text)


class Drawing:
    """A drawing function: where the inputs of its rasterizer come from."""

    def __init__(
        self,
        repo: HostRepo,
        module: str,
        function: Function,
        drawn_from: Collection[str] = (),  # what it may draw besides the values of plain 3DGS
        call: ast.Call | None = None,  # that draws; by default that whose picture it returns
        on: Collection[str] = (),  # arguments that are given, though they are off by default
    ) -> None:
        self.repo, self.module, self.function = repo, module, function
        self.drawn_from = drawn_from
        taken = function.args
        named = (*taken.posonlyargs, *taken.args, *taken.kwonlyargs)
        self.parameters = {each.arg for each in named}
        self.off = off_by_default(function) - {*on}
        given = [*zip(reversed(taken.args), reversed(taken.defaults), strict=False)]
        self.defaults = {a.arg: v for a, v in given}
        self.switches = {a.arg for a, v in given if isinstance(getattr(v, "value", None), bool)}
        self.values: dict[str, list[ast.expr]] = {}
        self.unasked = reading.skipped(function, reading.as_options(repo, ("arguments",)))
        read = (n for n in every(function, ast.Attribute) if n.attr.startswith("get_xyz"))
        models = [each.value.id for each in read if isinstance(each.value, ast.Name)]
        self.model = models[0] if models else "pc"
        self.call = call or _call(function, self._known)
        self.arguments = arguments(self.call)
        self.colours = set[str]()  # options, off by default, by which something else colours
        self.made: dict[str, tuple[str, ...]] = {
            each: (each,) for each in (*self.parameters, self.model)
        }
        self.drawn = self.made
        self._collect(function.body)
        self.made = self.drawn

    def _known(self, node: ast.AST) -> list[None]:
        """None for arguments that are off, and for attributes that nobody sets."""
        off = isinstance(node, ast.Name) and node.id in self.off
        return [None] if off or _never_set(self.repo, text_of(node)) else []

    def _collect(self, body: list[ast.stmt]) -> None:
        """Note what every name is made of, except where an argument is needed that is off."""
        for node in body:
            if any(each is self.call for each in nodes(node)):
                self.drawn = self.made
            before = self.made
            if isinstance(node, ast.If):
                coloured = self._is_colour_option(node)
                taken = False if coloured else reading.decided(node.test, self._known)
                self._collect([] if taken is False else node.body)
                if not taken:
                    then, self.made = self.made, before
                    self._collect(node.orelse)
                    self._join({} if taken is False else then)
            elif isinstance(node, ast.Assign):
                for target in node.targets:
                    self._assign(target, node.value)
            elif isinstance(node, ast.AnnAssign | ast.AugAssign):
                if node.value:
                    self._assign(node.target, node.value)
                    self._join(before if isinstance(node, ast.AugAssign) else {})
            elif isinstance(node, ast.Expr) and re.match(r"\w+\.\w+[^_]_\(", text_of(node)):
                self._assign(node.value.func.value, node.value)  # type: ignore[attr-defined]
                self._join(before)
            else:
                for field in ("body", "body", "orelse", "finalbody"):  # a loop's, twice
                    self._collect(getattr(node, field, []))
                    self._join(before)

    def _join(self, other: Mapping[str, tuple[str, ...]]) -> None:
        """Names may also be made as they are elsewhere."""
        joined = {each: (*self.made.get(each, ()), *made) for each, made in other.items()}
        self.made = self.made | {each: tuple(dict.fromkeys(made)) for each, made in joined.items()}

    def _is_colour_option(self, node: ast.If) -> bool:
        """Whether a branch makes colours if an option asks for it that is off by default."""
        option = node.test.attr if isinstance(node.test, ast.Attribute) else ""
        if option in ("", "convert_SHs_python"):
            return False
        made = any(text_of(each).startswith("colors_precomp = ") for each in node.body)
        if made and reading.off_in(self.repo, ("arguments",), option):
            self.colours.add(option)
        return option in self.colours

    def _assign(self, target: ast.expr, value: ast.expr) -> None:
        if isinstance(target, ast.Tuple):
            several = isinstance(value, ast.Tuple) and len(value.elts) == len(target.elts)
            for index, each in enumerate(target.elts):
                self._assign(each, value.elts[index] if several else value)  # type: ignore[attr-defined]
        elif isinstance(target, ast.Subscript):
            before = self.made
            self._assign(target.value, value)
            self._join(before)
        elif isinstance(target, ast.Name):
            self.values.setdefault(target.id, []).append(value)
            self.made = self.made | {target.id: tuple(dict.fromkeys(self._roots(value)))}

    def _roots(self, node: ast.expr | None) -> Iterator[str]:
        """What an expression is made of: "model.x", parameters, and "model" itself."""
        if node is None:
            return
        if isinstance(node, ast.Attribute) and isinstance(node.value, ast.Name):
            if self.made.get(node.value.id) == (self.model,):
                yield from (f"{self.model}.{each}" for each in self._given_by(node.attr))
                return
            yield from self._roots(node.value)
        elif isinstance(node, ast.Name):
            yield from self.made.get(node.id, ())
        elif isinstance(node, ast.Subscript):
            yield from self._roots(node.value)
        elif isinstance(node, ast.ListComp | ast.GeneratorExp):
            for each in node.generators:
                self._assign(each.target, each.iter)
            yield from self._roots(node.elt)
        elif isinstance(node, ast.Lambda | ast.Dict):
            return
        else:
            for child in ast.iter_child_nodes(node):
                part = child.value if isinstance(child, ast.keyword) else child
                if isinstance(part, ast.expr):
                    yield from self._roots(part)

    def _model(self) -> ModelClass:
        return ModelClass(self.repo, reading.home_of(self.repo, "scene") or reading.MODEL)

    def _given_by(self, name: str) -> list[str]:
        """The attributes of the model that an attribute gives: itself, or what its method does."""
        method = self._model().method(name)
        body = method.body[-1] if method and len(method.body) == 1 else None
        value = body.value if isinstance(body, ast.Return) else None
        given = value.elts if isinstance(value, ast.Tuple) else []
        own = [each.attr for each in given if re.fullmatch(r"self\.\w+", text_of(each))]  # type: ignore[attr-defined]
        return own if own and len(own) == len(given) else [name]

    def selection(self) -> str:
        """The code that picks rows of what is drawn first, as ``means3D[mask]``; "" without any."""
        gone = reading.skipped(self.function, self._known)  # by what is off
        given = {} if self.call in gone else self.arguments
        own, seen = f"{self.model}.get_xyz", set()
        waiting = [value for name, value in given.items() if name == "means3D"]
        while waiting:
            for node in ast.walk(waiting.pop()):
                if isinstance(node, ast.Name) and node.id not in seen:
                    seen.add(node.id)
                    waiting += self.values.get(node.id, [])
                elif (of := reading.chosen(node)) and own in self._roots(of):
                    return text_of(node)[:60]
        return ""

    def reasons(self) -> Iterator[tuple[str, bool]]:
        """Why the picture is not that of the PLY, and whether its rows are drawn all the same."""
        cuts = list(self.cuts())
        if cuts and not any(re.search(r"\[0?:3[,\]]", text_of(each)) for each in cuts):
            at = self._at(cuts[0])
            yield f"its picture is cut out of a tensor with further channels ({at})", False
        yield from self._others_first()
        yield from self.inputs()
        calls = read_calls(self.repo, self.module, self.function.name)
        names = dict.fromkeys([*self.arguments, *(n for each in calls for n in each.given)])
        blended = [each for each in names if _PICTURES.fullmatch(each)] or [*self._of_columns()]
        if blended:
            yield f"its rasterizer also takes {', '.join(blended)}", False
        for each in calls:
            if each.package == "an unknown package":
                yield f"its rasterizer was not read ({each})", False
            grounds = [e for e in self._roots(each.given.get("bg")) if f"{self.model}." in e]
            if grounds:
                yield f"its background is made of {', '.join(grounds)}", True
        for wrap in self._wraps():
            yield f"its {self.function.name} is wrapped by {wrap[:60]}", True
        for made in filter(None, map(self._made_into, pictures(self.function))):
            yield f"its picture is made into {text_of(made)[:60]} ({self._at(made)})", True

    def _wraps(self) -> Iterator[str]:
        """What decorates the function, or takes it and is then called by its name."""
        name, found = self.function.name, list(map(text_of, self.function.decorator_list))
        for module in (self.module, *_training(self.repo)):
            for node in getattr(self.repo.tree(module), "body", ()):
                again = isinstance(node, ast.Assign) and text_of(node.targets[0]) == name
                if again and name in map(text_of, getattr(node.value, "args", ())):
                    found.append(text_of(node.value))
        harmless = r"torch\.(no_grad|compile)|(functools\.)?partial\("
        yield from (each for each in found if not re.match(harmless, each))

    def _of_columns(self) -> Iterator[str]:
        """Arguments that further columns of the PLY may be, without channels beside the colours."""
        names = {*_columns(self._model())[1]} - _PLAIN
        further = {each for each in names if not change_of(each)}
        for name, value in self.arguments.items() if further else ():
            known = name in {*ARGUMENTS, *further} or _CHANNELS.search(name)
            others = [] if known else self._others(value)
            if any(each.startswith(f"{self.model}.") for each in others):
                yield name

    def _others_first(self) -> Iterator[tuple[str, bool]]:
        """Another picture that the rasterizer returns before the one that counts."""
        targets = [target for target, value in assigned(self.function) if value is self.call]
        names = [getattr(e, "id", "") for t in targets for e in getattr(t, "elts", ())]
        shown = {getattr(each, "id", "") for each in pictures(self.function)} & {*names}
        before = names[: min(map(names.index, shown), default=0)]
        if others := [each for each in before if _OTHERS.search(each)]:
            yield f"its rasterizer returns another picture first, {others[0]}", False

    def _made_into(
        self, value: ast.expr, seen: tuple[str, ...] = (), own: bool = False
    ) -> ast.expr | None:
        """The code that makes something else of the picture than its clamped numbers, or other
        numbers of the model's ``own`` values.
        """
        whole, of_model = value, f"{self.model}."
        while isinstance(value, ast.Call | ast.Subscript) and _call(value) is None:
            if isinstance(value, ast.Subscript):
                if isinstance(getattr(value.slice, "value", None), str):
                    return None
                if _cuts(value):
                    return whole
                value = value.value
                continue
            method = value.func
            named = text_of(method)
            if own and (named.rpartition(".")[0] == self.model or named in _ACTIVATING):
                return None
            if self._gives_back(getattr(method, "id", "")) and value.args:
                value = value.args[0]
                continue
            if getattr(method, "attr", "") not in (_SAME if own else _KEEPS):
                return None if text_of(method).startswith("bg_color.") else whole
            of: ast.expr = method.value  # type: ignore[attr-defined]
            value = value.args[0] if text_of(of) == "torch" else of
        if isinstance(value, ast.Compare | ast.UnaryOp):
            return whole
        if isinstance(value, ast.BinOp):
            behind = isinstance(value.op, ast.Add) and _ADDED.search(text_of(value.right))
            return self._made_into(value.left, seen, own) if behind else whole
        if seen and isinstance(value, ast.Constant) and value.value is not None:
            return whole
        if own and text_of(value) in (f"{of_model}_scaling", f"{of_model}_opacity"):
            return whole
        name = getattr(value, "id", "")
        others = self.values.get(name, []) if name not in seen else []
        if own and self.call:  # what is neither of the model nor a number is unknown
            before = [each for each in others if each.lineno <= self.call.lineno]
            others = [e for e in before if isinstance(e, ast.Constant) or any(self._roots(e))]
        made = (self._made_into(e, (*seen, name), own) for e in others if self._counts(e))
        return next((each for each in made if each is not None), None)

    def _counts(self, value: ast.expr) -> bool:
        """Whether a value is given by default."""
        return value not in self.unasked

    def _gives_back(self, name: str) -> bool:
        """Whether a function returns first what its first argument is, or begins with."""
        function = self.repo.function(self.module, name)
        kept = {each.arg for each in function.args.args[:1]} if function else set()
        for target, value in assigned(function):
            if getattr(value, "id", "") in kept and isinstance(target, ast.Tuple):
                kept |= {getattr(target.elts[0], "id", "")}
        given = [node.value for node in every(function, ast.Return)]
        return bool(given) and all(getattr(first_of(each), "id", "") in kept for each in given)

    def inputs(self) -> Iterator[tuple[str, bool]]:
        """Inputs of its call that a plain drawing does not have, and whether arguments of
        the function make them from the model's own.
        """
        yield from self.shapes()
        given, name, at = self.arguments, self.function.name, self._at(self.function)
        if others := self._others(given.get("shs")):
            yield f"{name} makes colours from {', '.join(others[:4])} ({at})", False
        for each in (*(e.given for e in read_calls(self.repo, self.module, name)), given):
            for argument, usual in _USUAL.items():
                value = each.get(argument)
                value = self.defaults.get(getattr(value, "id", ""), value)
                if not isinstance(value, ast.Name | None) and getattr(value, "value", 0) != usual:
                    how = f"{argument}={text_of(value)}, not {usual!r}"
                    yield f"{name} draws with {how} ({at})", True
        if value := given.get("colors_precomp"):
            channels = list(self._channels(value))
            others = [text_of(value)] if isinstance(value, ast.Call) else self._others(*channels)
            if others:
                roots = (root for each in channels for root in self._roots(each))
                own = any(each.startswith(f"{self.model}.get_features") for each in roots)
                what = f"makes colours from {', '.join(others[:4])} ({self._at(value)})"
                yield f"{name} {what}", own and self._beside(others)
            elif not self.drawn_from and (
                made := next(filter(None, map(self._other_colours, channels)), None)
            ):
                what = f"colours that are not max(harmonics + 0.5, 0), {text_of(made)[:60]}"
                yield f"{name} makes {what} ({self._at(made)})", True

    def _other_colours(self, value: ast.expr, seen: tuple[str, ...] = ()) -> ast.expr | None:
        """The code that makes colours of the model's features in another way than 3DGS."""
        name = getattr(value, "id", "")
        if name:
            others = self.values.get(name, []) if name not in seen else []
            made = (self._other_colours(e, (*seen, name)) for e in others if self._counts(e))
            return next(filter(None, made), None)
        drawn = text_of(getattr(self.call, "func", None))
        own = any("features" in e for e in self._roots(value)) and "rasterization" not in drawn
        clamped = _CLAMPED.fullmatch(text_of(value))
        texts = [clamped[1], *map(text_of, self.values.get(clamped[1], []))] if clamped else []
        return value if own and not any(each.startswith("eval_sh(") for each in texts) else None

    def shapes(self) -> Iterator[tuple[str, bool]]:
        """Likewise where its Gaussians are, and how large and opaque."""
        own = {"means3D": "get_xyz", "scales": "get_scaling", "rotations": "get_rotation"}
        own["cov3D_precomp"] = "get_covariance"
        for argument in ("means3D", "opacities", "scales", "rotations", "cov3D_precomp"):
            value = self.arguments.get(argument)
            named = self.values.get(getattr(value, "id", ""), [])
            if argument == "cov3D_precomp":
                if not any(self._counts(each) and not is_off(each) for each in named):
                    continue
                if not self.drawn_from:
                    yield from ((each, True) for each in _of_covariances(self._model()))
            if others := self._others(value):
                what = f"makes {argument} from {', '.join(others[:4])}, not from its PLY alone"
                kept = f"{self.model}.{own.get(argument)}" in self._roots(value)
                said = f"{self.function.name} {what} ({self._at(self.function)})"
                yield said, kept and self._beside(others)
                continue
            roots = {*self._roots(value)} if value and not self.drawn_from else set()
            alone = roots and all("." in e or e.startswith("scal") for e in roots)
            if alone and (made := self._made_into(value, own=True)):  # type: ignore[arg-type]
                what = f"makes {argument} otherwise than its PLY has them, {text_of(made)[:60]}"
                yield f"{self.function.name} {what} ({self._at(made)})", False

    def _others(self, *values: ast.expr | None) -> list[str]:
        """What values are made of that a plain drawing does not read, each once."""
        roots = dict.fromkeys(root for each in values for root in self._roots(each))
        return [each for each in roots if not self._plain(each)]

    def _at(self, node: ast.expr | Function) -> str:
        return self.repo.at(self.module, node.lineno)

    def _channels(self, value: ast.expr) -> Iterator[ast.expr]:
        """What the first channels are, where the picture is cut out of more."""
        name = getattr(value, "id", "")
        for each in self.values.get(name, [value]) if any(self.cuts()) else [value]:
            parts = each.args[:1] if isinstance(each, ast.Call) else []
            listed = parts and isinstance(parts[0], ast.Tuple | ast.List)
            first = parts[0].elts[0] if listed else each  # type: ignore[attr-defined]
            if not listed or getattr(first, "id", "") != name:  # else it is joined to itself
                yield first

    def _beside(self, roots: list[str]) -> bool:
        """Whether these are neither the model as a whole nor other values of its rows."""
        return not any(re.match(rf"{self.model}($|\.get_)", each) for each in roots)

    def cuts(self) -> Iterator[ast.expr]:
        """What takes channels out of the picture that the rasterizer returns."""
        whole = {
            getattr(first_of(target), "id", "")
            for target, value in assigned(self.function)
            if value is self.call
        } - {""}
        for node in nodes(self.function):
            if isinstance(node, ast.Attribute) and node.attr in ("split", "chunk", "unbind"):
                inner = node.value
                while isinstance(inner, ast.Subscript):
                    inner = inner.value
            elif isinstance(node, ast.Subscript):
                first, inner = first_of(node.slice), node.value
                if not isinstance(first, ast.Slice) or not (first.lower or first.upper):
                    continue
            else:
                continue
            if getattr(inner, "id", "") in whole:
                yield node

    def _plain(self, root: str) -> bool:
        _, dot, attribute = root.partition(".")
        if (attribute or root) in self.drawn_from:
            return True
        if dot:
            return bool(_OF_MODEL.fullmatch(attribute))
        return root in self.switches or (root != self.model and bool(_OF_CALL.fullmatch(root)))
