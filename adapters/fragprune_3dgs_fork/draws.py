"""How a fork draws: its functions, the calls of the rasterizer, and what its values are."""

from __future__ import annotations

import ast
import re
from collections.abc import Collection, Iterator
from functools import partial

import fragprune_graphdeco as graphdeco
from fragprune_3dgs_fork import rasterizer
from fragprune_3dgs_fork.fork import CAMERA, MODEL, RENDERER, Draw, Fork, method_calls
from fragprune_3dgs_fork.rasterizer import Output
from fragprune_graphdeco import (
    Drawing,
    arguments,
    assigned,
    every,
    is_off,
    kernels,
    mentioned,
    off_by_default,
    reading,
    syntax,
    text_of,
)
from fragprune_plugins.adapting import Function, nodes

_MODEL_ARGUMENTS = ("pc", "gaussians", "gaussian", "model")
NEUTRAL = {"antialiasing", "confidence", "projmatrix_raw"}
"""Further settings that the engines know, or that are checked to be neutral at every call."""
HANDED = ("detach", "clone", "contiguous", "squeeze", "unsqueeze")
"""Methods of a value that nobody reads yet: it is handed on in another shape."""
_EMPTY = re.compile(r"torch\.(empty|zeros)\(0[,)]")
_PROVABLE = re.compile(r"^(?!.*(median|max|normal|var|dist)).*(depth|alpha|acc|opac)")
"""Names of values that a proof can tell, if they are what they are called."""


def read_draws(fork: Fork) -> None:
    """The drawing functions that a script names, and their calls."""
    functions, repo = fork.drawing, fork.repo
    drawing = [each for each in fork.trees.values() if not mentioned(each).isdisjoint(functions)]
    named = {name for tree in drawing for name in _reached(fork, tree)}
    pairs = ((name, repo.function(RENDERER, name)) for name in functions)
    drawn = {name: body for name, body in pairs if body}
    while more := {n for name in drawn.keys() & named for n in mentioned(drawn[name])} - named:
        named |= more
    for node, options in fork.optional.items():
        if {getattr(node, kind, "") for kind in ("id", "attr", "name")} & {*functions} - named:
            fork.options |= options
    bodies = {name: body for name, body in drawn.items() if name in named}
    trees = (*fork.trees.values(), *bodies.values())
    called = {getattr(n, "id", getattr(n, "attr", "")) for each in trees for n in nodes(each)}
    for name, body in bodies.items():
        parameters = repo.parameters(RENDERER, name) or ()
        model = next((each for each in _MODEL_ARGUMENTS if each in parameters), "")
        at = f"{RENDERER}:{name} ({repo.place(RENDERER, name)})"
        refuse = partial(fork.refuse, "rasterizer-call", at)
        calls = tuple(graphdeco.read_calls(repo, RENDERER, name))
        further = [each for each in parameters if each != model]
        camera = next((each for each in further if CAMERA.match(each)), next(iter(further), ""))
        if not model or not camera or parameters.index(model) < parameters.index(camera):
            refuse(f"arguments {', '.join(parameters)}", "a camera and a model")
            continue
        if not calls or not all(call.names for call in calls):
            refuse("a result that is not unpacked", "its values")
            continue
        fork.draws += (Draw(name, camera, model, calls),)
        source = Drawing(repo, RENDERER, body)
        filled = {getattr(each.value, "id", "") for each in every(body, ast.Subscript)}
        for call in calls:
            _check_call(fork, at, name, call)
            blended = text_of(call.given.get(fork.blended.get(call.package, "")))
            made = " ".join(map(text_of, source.values.get(blended, [])))
            if blended not in filled and re.search(r"torch\.(zeros|empty)\(", made):
                refuse(f"{blended}, which is empty unless asked for", "channels of every Gaussian")
        others, moving = _others(fork, body)
        for found in others if name in called else ():
            refuse(found, "the model's own Gaussians, all of them")
        for cut in [*source.cuts()][:1]:
            refuse(f"a picture of more channels, {text_of(cut)}", "a picture")
        fork.colours |= source.colours
        fork.options |= moving
    if not fork.draws and not any(each.code == "rasterizer-call" for each in fork.findings):
        at = f"{RENDERER} ({repo.place(RENDERER, 'render')})"
        fork.refuse("rasterizer-call", at, "no drawing function that a script calls", "render")


def _others(fork: Fork, body: Function) -> tuple[list[str], set[str]]:
    """How a drawing function draws other Gaussians than all of its model's own, and the options,
    off by default, that scripts hand to it and under which it does.
    """
    scripts = (each for tree in fork.trees.values() for each in every(tree, ast.Call))
    given = graphdeco.given_to(body, (each for each in scripts if each not in fork.optional))
    asked = {key: getattr(value, "attr", "") for key, value in given.items()}
    options = {k: v for k, v in asked.items() if reading.off_in(fork.repo, fork.command, v)}

    always = given.keys() - options.keys()
    calls = [each for each in every(body, ast.Call) if "means3D" in arguments(each)]

    def drawn(shaped: Collection[str], chosen: Collection[str]) -> list[str]:
        made = partial(Drawing, fork.repo, RENDERER, body)
        shapes = (each for call in calls for each in made(call=call, on=shaped).shapes())
        found = [why for why, moves in shapes if not moves]
        return found + [each for call in calls for each in made(call=call, on=chosen).selected()]

    off, usual = options.keys() & off_by_default(body), drawn(always, always)
    moving = {options[key] for key in off if drawn(*2 * ({*always, key},)) != usual}
    return drawn((), always), moving


def _reached(fork: Fork, node: ast.AST) -> Iterator[str]:
    """Names and imports in a script, without those under an option that is off by default."""
    for kind in ("id", "attr", "name"):
        if isinstance(name := getattr(node, kind, None), str):
            yield name
    for each in ast.iter_child_nodes(node):
        if each not in fork.optional:
            yield from _reached(fork, each)


def _check_call(fork: Fork, at: str, function: str, call: graphdeco.CallInSource) -> None:
    """Settings and arguments besides the known ones: off, or without a part in the picture."""
    if blended := rasterizer.blended_argument(fork.repo, call):
        fork.blended[call.package] = blended
    if call.other_matrix:
        found = f"projmatrix is {call.other_matrix}"
        fork.refuse("rasterizer-call", at, found, "the cameras of 3DGS")
    if rasterizer.POSES & call.arguments:
        fork.warn("rasterizer-call", at, "the cameras, which stand still in stage 2")
    screens = frozenset(filter(rasterizer.SCREEN.fullmatch, call.arguments))
    fork.screens |= screens
    given = call.arguments - rasterizer.SERVED - screens - {blended}
    further = [*(call.besides - NEUTRAL), *given]
    body = fork.repo.function(RENDERER, function)
    unknown = {each for each in further if not _stays_off(fork, body, call.given.get(each))}
    fork.off |= {*further} - unknown
    for name in sorted(unknown & call.besides):
        changed = rasterizer.changed_gradients(fork.repo, call.package, name)
        if rasterizer.only_asks(fork.repo, call.package, name):
            unknown.remove(name)
            fork.asking |= {name}
        elif rasterizer.rests(fork.repo, call.package, name, fork.off):
            unknown.remove(name)
        elif changed is not None and changed <= {"means2D"}:
            unknown.remove(name)
            fork.scaled |= {name}
            fork.warn("rasterizer-call", at, f"the gradient on the screen, which {name} changes")
    if unknown:
        found = f"{', '.join(sorted(unknown))}, unknown to fragprune"
        fork.refuse("rasterizer-call", at, found, "settings and arguments whose effect is known")


def _stays_off(fork: Fork, scope: ast.AST | None, value: ast.expr | None) -> bool:
    """Whether a value in a drawing function or a script is None, False or empty unless a user asks
    for more; every call is checked.
    """
    if isinstance(value, ast.Attribute):
        return reading.off_in(fork.repo, (MODEL, *fork.command), value.attr)
    if not isinstance(value, ast.Name):
        return is_off(value) or bool(_EMPTY.match(text_of(value)))
    if not isinstance(scope, ast.FunctionDef):
        return _made_off(fork, scope, value.id, set())
    if value.id not in (off := off_by_default(scope)):
        named = [each for each in every(scope, ast.Name) if each.id in off]
        unasked = {each.id for each in named if _stays_off(fork, scope, each)}
        return _made_off(fork, scope, value.id, unasked)
    calls = [(tree, each) for tree in fork.trees.values() for each in every(tree, ast.Call)]
    names = {True: fork.repo.parameters(RENDERER, scope.name) or (), False: ()}
    given = ((t, syntax.passed(c, names[text_of(c.func) == scope.name])) for t, c in calls)
    return all(_stays_off(fork, t, each.get(value.id, ast.Constant(None))) for t, each in given)


def _made_off(fork: Fork, scope: ast.AST | None, name: str, unasked: set[str]) -> bool:
    """Likewise for what code calls by a name, without arguments that nobody gives."""
    gone = syntax.skipped(scope, lambda node: [None] if getattr(node, "id", "") in unasked else [])
    targets = [n for n in every(scope, ast.Name) if n.id == name and isinstance(n.ctx, ast.Store)]
    made = {to: value for to, value in assigned(scope) if to in targets}
    fork.options |= frozenset().union(*(fork.optional.get(each, ()) for each in made))
    kept = [made[to] for to in made if to not in gone and to not in fork.optional]
    known = len(made) == len(targets) and not any(isinstance(each, ast.Name) for each in kept)
    return bool(kept) and known and all(_stays_off(fork, scope, each) for each in kept)


def read_outputs(fork: Fork) -> None:
    """What each rasterizer returns; refused where a value is read and its meaning is unknown."""
    for draw, call in ((each, call) for each in fork.draws for call in each.calls):
        roles = tuple(_output(fork, draw, call, number) for number in range(len(call.names)))
        known = fork.outputs.get(call.package, roles)
        if len(known) != len(roles):
            at, found = fork.repo.at(RENDERER, call.line), f"{len(roles)} and {len(known)} values"
            fork.refuse("rasterizer-call", at, found, "one form")
            continue
        fork.outputs[call.package] = tuple(
            each if each.role != "unread" else former
            for each, former in zip(roles, known, strict=True)
        )
    for package, roles in fork.outputs.items():
        names = [each.role for each in roles]
        if names[:1] != ["image"] or names.count("radii") != 1:
            found = f"values {', '.join(each.name or '?' for each in roles)}"
            fork.refuse("rasterizer-output", package, found, "a picture, and the radii once")


def _output(fork: Fork, draw: Draw, call: graphdeco.CallInSource, number: int) -> Output:
    name, package = call.names[number], call.package
    if number == 0:
        return Output(name, "image")
    if "radii" in name:
        return Output(name, "radii")
    output = rasterizer.meaning(fork.repo, call, name)
    uses = _uses(fork, draw, name) if output.role in ("unread", "unproved") else {}
    read = output.role == "unread" and kernels.normal_sources(fork.repo, package)
    at = fork.repo.at(RENDERER, call.line)
    if uses and _PROVABLE.search(name) and not read:
        fork.warn("rasterizer-output", at, f"what {package} returns as {name}")
        return Output(name, "unproved")
    if uses and fork.early.issuperset(uses):
        found = f"{name}, by which it densifies and which only its own rasterizer gives"
        fork.warn("rasterizer-output", at, found)
    elif uses:
        places = [place for node, place in uses.items() if node not in fork.early]
        found = f"{name}, read in {places[0]}, whose meaning is unknown"
        expected = "picture, radii, and sums along the ray whose kernel was read"
        at = f"{RENDERER}:{draw.function} ({at})"
        fork.refuse("rasterizer-output", at, found, expected)
    return output if output.role != "unproved" else Output(name, "unread")


def _uses(fork: Fork, draw: Draw, name: str) -> dict[ast.AST, str]:
    """What reads an output, and where: in its function, or by its key where scripts draw."""
    body = fork.repo.function(RENDERER, draw.function)
    if body is None or name in ("", "_"):
        return {}
    keys, handed = set[str](), set[ast.AST]()
    dicts = every(body, ast.Dict)
    pairs = [pair for each in dicts for pair in zip(each.keys, each.values, strict=True)]
    pairs += [(to.slice, value) for to, value in assigned(body) if isinstance(to, ast.Subscript)]
    for key, value in pairs:
        while isinstance(value, ast.Call) and getattr(value.func, "attr", "") in HANDED:
            value = value.func.value  # type: ignore[attr-defined]
        if isinstance(key, ast.Constant) and getattr(value, "id", "") == name:
            keys.add(str(key.value))
            handed.add(value)
    places: dict[ast.AST, str] = {
        node: fork.repo.at(RENDERER, node.lineno)
        for node in every(body, ast.Name)
        if node.id == name and isinstance(node.ctx, ast.Load) and node not in handed
    }
    for module, tree in fork.trees.items():
        still = (node for node, method in method_calls(tree) if method in fork.still)
        passed = {inner for node in still for inner in nodes(node)}
        named = ((to, value) for to, value in assigned(tree) if isinstance(to, ast.Name))
        given: dict[ast.AST, str] = {value: to.id for to, value in named}
        loads = [n for n in every(tree, ast.Name) if isinstance(n.ctx, ast.Load)]
        for node in nodes(tree):
            read = isinstance(node, ast.Subscript) and isinstance(node.ctx, ast.Load)
            index = node.slice if read else None  # type: ignore[attr-defined]
            if isinstance(node, ast.Call) and getattr(node.func, "attr", "") == "get":
                index = node.args[0] if node.args else None
            if getattr(index, "value", None) not in keys or not keys or node in passed:
                continue
            own = [n for n in loads if n.id == given[node]] if node in given else [node]
            for each in (n for n in own if n not in passed):
                if optional := fork.optional.get(each, fork.optional.get(node)):
                    fork.options |= optional
                else:
                    places[each] = fork.repo.at(module, each.lineno)  # type: ignore[attr-defined]
    return places
