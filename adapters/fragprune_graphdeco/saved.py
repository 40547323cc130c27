"""What a model saves: the columns of its PLY, and whether they hold its parameters as they are."""

from __future__ import annotations

import ast
import re
from collections.abc import Iterator

from fragprune_graphdeco import reading
from fragprune_graphdeco.reading import ModelClass
from fragprune_graphdeco.syntax import assigned, entries, every, text_of
from fragprune_plugins.adapting import Function

COLUMNS = ("f_dc", "f_rest", "opacity", "scale", "rot")
PLAIN = {"x", "y", "z", "nx", "ny", "nz", "l", *COLUMNS}
SAME = {
    *("clone", "contiguous", "cuda", "detach", "expand", "float", "permute", "repeat", "reshape"),
    *("squeeze", "to", "unsqueeze", "view"),
}
"""Methods that keep numbers."""
_STORES = {*SAME, "astype", "cpu", "flatten", "numpy", "transpose"}
"""Methods that keep the numbers of a PLY."""
LISTS = "construct_list_of_attributes"


def columns(model: ModelClass) -> tuple[Function | None, list[str]]:
    """The function that lists a PLY's columns, and their names without numbers."""
    calls = (text_of(each.func) for each in every(model.saver, ast.Call))
    asked = (model.method(each[5:]) for each in calls if each.startswith("self."))
    lists = (each for each in asked if "'opacity'" in text_of(each))
    listed = model.method(LISTS) or next(lists, model.saver)
    names = dict.fromkeys(
        re.sub(r"_?(\{\})?\d*$", "", node.value)
        for node in every(listed, ast.Constant)
        if isinstance(node.value, str)
    )
    return listed, [each for each in names if each.isidentifier()]


def elements(model: ModelClass) -> Iterator[str]:
    """Elements of other names than the one that is read."""
    calls = [e for e in every(model.saver, ast.Call) if text_of(e.func).endswith(".describe")]
    texts = [arg for each in calls for arg in each.args[1:2] if not isinstance(arg, ast.Name)]
    if texts and "'vertex'" not in map(text_of, texts):
        at = model.repo.at(model.module, texts[0].lineno)
        yield f"its PLY has elements {text_of(texts[0])}, no vertex ({at})"


def scales(model: ModelClass) -> Iterator[str]:
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


def values(model: ModelClass) -> Iterator[str]:
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
    if isinstance(value, ast.Call) and text_of(method).endswith("numpy"):
        return any(map(_other_numbers, value.args))
    known = re.search(r"inverse|log|gather|np\.(zeros|ones)", text_of(method))
    return not (known or isinstance(value, ast.Name | ast.Attribute))


def _assigned_names(save: Function | None) -> list[ast.Assign]:
    """What a function assigns to variables."""
    return [each for each in every(save, ast.Assign) if isinstance(each.targets[0], ast.Name)]


def _takes(node: ast.Assign, kind: str) -> bool:
    """Whether a value is made of what a getter activates, and not only compared with it."""
    found = re.search(rf"self\.get_{kind}\b", text_of(node.value))
    return bool(found) and not isinstance(node.value, ast.Compare)


def activations(model: ModelClass) -> Iterator[str]:
    """Other activations than those of 3DGS, wherever they are set, and getters that are replaced.

    What is saved activated needs none.
    """
    repo, module = model.repo, model.module
    saved = _assigned_names(model.saver)
    text = "".join([text_of(repo.tree(module)), *reading.texts_of(repo).values()])
    functions = every(repo.tree(module), ast.FunctionDef)
    used = ("__init__", "setup_functions")
    made_of = [e for e in functions if e.name in used or f".{e.name}(" in text]
    own = [e for e in getattr(repo.tree(module), "body", ()) if isinstance(e, ast.Assign)]
    places: list[tuple[str, ast.AST]] = [(module, each) for each in (*made_of, *own)]
    places += [(each, tree) for each in reading.training_modules(repo) if (tree := repo.tree(each))]
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


def getters(model: ModelClass) -> Iterator[tuple[str, bool]]:
    """Getters of other values than the PLY's; true if only where an attribute was set later."""
    saved = text_of(model.saver)
    if model.method("get_xyz") is None:  # a class that only saves
        model = ModelClass(model.repo)
    always = reading.computed_getters(model, reading.unset(model))
    options = reading.options(model, reading.training_modules(model.repo))
    _, home = reading.definition_of(model.repo, model.module, model.name)
    bases = [text_of(each) for each in getattr(home, "bases", ())]
    if {*bases} - {"object", "nn.Module", "torch.nn.Module"} and model.method("get_xyz"):
        for kind in (kind for kind, getter in model.getters.items() if getter is None):
            yield f"get_{kind} is that of {', '.join(bases)}, which was not read", False
    for kind in reading.computed_getters(model, options):
        if kind != "xyz" or "self.get_xyz" not in saved:
            yield f"get_{kind} is computed ({model.at(f'get_{kind}')})", kind not in always


def positions(model: ModelClass) -> Iterator[str]:
    """Positions that no optimizer moves: something else makes them for every picture."""
    setup, created = model.method("training_setup"), text_of(model.method("create_from_pcd"))
    trained = " ".join(map(text_of, entries(setup, "params")))
    fixed = re.search(r"self\._xyz = .*requires_grad_\(False\)", created)
    if "self._opacity" in trained and not (fixed or re.search(r"self\._xyz\b", trained)):
        at = model.at("training_setup")
        yield f"its optimizer does not train positions, which are made otherwise ({at})"
