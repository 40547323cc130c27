"""Does a training make the drawn picture itself like its photographs? Read from its scripts.

A model of what lies between the scene and the camera (water, exposure), a style, or a mask in the
loss makes them differ: a model that then learned the photographs as they are would unlearn it.
"""

from __future__ import annotations

import ast
import re
from collections.abc import Collection, Iterable, Iterator

from fragprune_graphdeco import reading
from fragprune_graphdeco.syntax import assigned, every, skipped, text_of
from fragprune_plugins.adapting import Function, HostRepo, nodes

NOT_FOUND = "what its training compares with photographs was not found"

_LOSS = re.compile(r"l1|l2|ssim|mse|huber|charbonnier|lpips|loss", re.IGNORECASE)
"""In names of functions that compare two pictures."""
_PHOTOGRAPH = re.compile(r".+\.(original_image|image|get_image\(\))")
_BESIDE = re.compile(r"(\w+\.)*(\w*alpha_mask|background|bg|bg_color)(\.cuda\(\))?")
"""What a photograph with an alpha channel, and the picture with it, are cut by or put on."""
_MASK = re.compile(r"(?<!alpha_)mask|conf(?!ig)|uncert|valid(?!at)")  # in names of a loss's weights
_CHANGES = re.compile(
    r"self\.(FoV[xy] ([*/+-]=|= (self\.)?FoV[xy] )|"
    r"original_image (\*\*=|=.*(\*\* |\.(pow|mean)\()))",
    re.IGNORECASE,
)
"""Statements by which a camera changes its photograph, or the angles that it was taken with."""
_RECOLOURS = re.compile(r"gamma|linear|rgb_to|cctf|tone_?map|\bpow(er)?$", re.IGNORECASE)
"""In names of functions that give a photograph other colours."""
_POSES = re.compile(
    r"\{'params': .*'name': (f?'(?:pose|cam(?:era)?s?)(?:_\w*)?\W.*)\}"
    r"|\{'params': \[?((?:view\w*|cam\w*)\.\w+)\W.*\}"
)
"""A group of an optimizer that moves cameras."""
_KEEPS = {
    *("clamp", "clip", "contiguous", "cuda", "detach", "float", "permute", "squeeze", "to"),
    *("type", "unsqueeze"),
}
"""Methods, and functions of torch, that keep what a picture shows."""


def unlike(repo: HostRepo, scripts: Iterable[str]) -> str:
    """Why a model's pictures may differ from the photographs; "" if all scripts compare the two.

    What scripts do only under options that are off by default does not count.
    """
    found = [*_of_cameras(repo), *(why for each in scripts for why in _of_script(repo, each))]
    said = sorted(filter(None, found), key=NOT_FOUND.__eq__)  # what was found comes first
    return (said or found or [NOT_FOUND])[0]


def _of_cameras(repo: HostRepo) -> Iterator[str]:
    """How cameras change their photographs, or the angles that these were taken with."""
    found: list[tuple[str, ast.AST]] = []
    for node in every(repo.tree("scene.cameras"), ast.stmt):
        found += [("scene.cameras", node)] * bool(_CHANGES.match(text_of(node)))
    for module, name in (("utils.general_utils", "PILtoTorch"), ("utils.camera_utils", "loadCam")):
        for call in every(repo.function(module, name), ast.Call):
            found += [(module, call)] * bool(_RECOLOURS.search(text_of(call.func)))
    for asked in every(repo.tree("scene.dataset_readers"), ast.If):
        texts = (getattr(each, "value", 0) for each in getattr(asked.test, "values", ()))
        if any(isinstance(each, str) for each in texts):  # it is true of any camera's model
            found.append(("scene.dataset_readers", asked.test))
    for module, what in found:
        at = repo.at(module, getattr(what, "lineno", 0))
        yield f"its cameras change what they see, {text_of(what)[:60]} ({at})"


def _of_script(repo: HostRepo, script: str) -> Iterator[str]:
    """``unlike`` of a script and what it imports; nothing if none of that learns."""
    why, learns, known = NOT_FOUND, False, reading.as_options(repo, ("arguments", script))
    for module, tree in reading.reached(repo, [script]).items():
        for group in every(tree, ast.Dict):
            if moves := _POSES.fullmatch(text_of(group)):
                named, at = moves[1] or moves[2], repo.at(module, group.lineno)
                yield f"its training may move its cameras, the group {named} ({at})"
        for function in reading.learning(tree):
            learns, gone = True, skipped(function, known)
            for node, sides in (pair for pair in _compared(function) if pair[0] not in gone):
                kinds = [_kinds(function, each, gone) for each in sides]
                if sorted(map(sorted, kinds)) == [["drawn"], ["photograph"]]:
                    why = ""
                elif {"drawn", "photograph"} <= set.union(*kinds) or (
                    {"photograph"} in kinds and any(_draws(function, each) for each in sides)
                ):
                    texts = " with ".join(text_of(each)[:40] for each in sides)
                    yield f"its training compares {texts} ({repo.at(module, node.lineno)})"
            for node in (each for each in every(function, ast.BinOp) if each not in gone):
                weights = [e for e in (node.left, node.right) if _MASK.search(text_of(e))]
                pairs = [pair for pair in _compared(function) if pair[0] in nodes(node)]
                if isinstance(node.op, ast.Mult) and len(weights) == 1:
                    each_of = [[_kinds(function, e, gone) for e in sides] for _, sides in pairs]
                    if any({"drawn", "photograph"} <= set.union(*each) for each in each_of):
                        at = repo.at(module, node.lineno)
                        what = text_of(weights[0])[:40]
                        yield f"its training weighs what it compares, {what} ({at})"
    yield from [why] * learns


def _draws(function: Function, value: ast.expr) -> bool:
    """Whether a call that is no loss makes something of the drawn picture."""
    called = value.args if isinstance(value, ast.Call) else []
    return any("drawn" in _kinds(function, each, ()) for each in called)


def _compared(function: Function) -> Iterator[tuple[ast.expr, list[ast.expr]]]:
    """Pairs of which a loss is made: those that functions get, and differences."""
    for call in every(function, ast.Call):
        if len(call.args) > 1 and _LOSS.search(text_of(call.func).split(".")[-1]):
            yield call, call.args[:2]
    for node in every(function, ast.BinOp):
        if isinstance(node.op, ast.Sub):
            yield node, [node.left, node.right]


def _kinds(function: Function, value: ast.expr, gone: Collection[ast.AST]) -> set[str]:
    """What a value is made of, without what is ``gone``: "drawn", "photograph", other code."""
    kinds, seen, waiting = set[str](), set[str](), [value]
    for node in waiting:  # it grows
        text = text_of(node)
        if isinstance(node, ast.Constant) or _BESIDE.fullmatch(text) or text in seen:
            continue
        if _PHOTOGRAPH.fullmatch(text):
            kinds.add("photograph")
        elif getattr(getattr(node, "slice", None), "value", "") == "render":
            kinds.add("drawn")
        elif parts := _parts(function, node):
            waiting += [each for each in parts if each not in gone]
        else:
            kinds.add(text)
        seen.add(text)
    return kinds


def _parts(function: Function, node: ast.expr) -> list[ast.expr]:
    """What a value is made of by keeping, cutting or blending it, or by a name; [] if otherwise."""
    if isinstance(node, ast.Subscript):
        return [node.value]
    if isinstance(node, ast.BinOp) and not isinstance(node.op, ast.Pow):
        return [node.left, node.right]
    if isinstance(node, ast.IfExp):
        return [node.body, node.orelse]
    if isinstance(node, ast.Call) and getattr(node.func, "attr", "") in _KEEPS:
        of = getattr(node.func, "value", node)
        return node.args[:1] if text_of(of) in ("torch", "jt") else [of]
    if not isinstance(node, ast.Name):
        return []
    changed = [e.value for e in every(function, ast.AugAssign) if text_of(e.target) == node.id]
    for each in every(function, ast.Expr):
        owner, _, name = text_of(getattr(each.value, "func", None)).rpartition(".")
        if owner == node.id and name.endswith("_") and name.rstrip("_") not in _KEEPS:
            changed.append(each.value)
    parts = (to for to, _ in assigned(function) if isinstance(to, ast.Subscript))
    changed += [to.slice for to in parts if text_of(to.value) == node.id]
    named = ((map(text_of, getattr(to, "elts", [to])), made) for to, made in assigned(function))
    return [*(made for names, made in named if node.id in names), *changed]
