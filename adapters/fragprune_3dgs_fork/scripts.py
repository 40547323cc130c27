"""Reads the scripts of a fork: which train, and whether they can be served and resumed."""

from __future__ import annotations

import ast
import re
from collections.abc import Collection, Iterator
from functools import partial

import fragprune_graphdeco as graphdeco
from fragprune_3dgs_fork.fork import (
    CAMERA,
    CHECKPOINT,
    CLASS,
    LOOPS,
    MODEL,
    RENDERER,
    Fork,
    method_calls,
    methods_of,
    under,
)
from fragprune_graphdeco import (
    assigned,
    every,
    failing,
    is_off,
    mentioned,
    plain,
    reading,
    syntax,
    text_of,
)
from fragprune_plugins.adapting import HostRepo, nodes

_CHECKPOINT = re.compile(
    rf"(^|[/'\"]){CHECKPOINT}(['\"] \+ str\(\w+\) \+ ['\"]|{{\w*(:\w+)?}}|%d)\.pth"
)
"""A checkpoint's name in a source: its beginning, the iteration and nothing else."""
_PROCESSES = re.compile(
    r"\bProcess\((.*\W)?target=|\bmp\.spawn\(|\b(DDP|DistributedDataParallel)\("
)
_EMPTIES = re.compile(r"\brmtree\(\w+\.model_path")
"""A script that removes its output folder, and with it the checkpoint to resume."""


def read_scripts(fork: Fork, scripts: tuple[str, ...]) -> None:
    """Of these scripts, the training scripts of the model class: they make it once."""
    repo = fork.repo
    for script in scripts:
        module, networks = reading.module_of(script), _networks(repo, script)
        made = [each for each in reading.made_models(repo, module) if each not in networks]
        if CLASS in made and len(set(made)) == 1:
            fork.scripts += (script,)
            fork.options |= failing.overruling(repo, module)
            for found in failing.reasons(repo, (script,)):
                fork.refuse("script", script, found, "a script that runs")
            if len(made) > 1 or _in_loop(fork.tree(script), CLASS):
                fork.one_run = f"{script} makes several models"
        elif made:
            fork.unserved[script] = f"makes {', '.join(dict.fromkeys(made))}"
    if not fork.scripts:
        others = "; ".join(f"{script} {why}" for script, why in fork.unserved.items())
        names = (each.stem for each in sorted(repo.root.glob("*train*.py")))
        broken = [f"{each}.py is no valid Python" for each in names if repo.tree(each) is None]
        found = others or "; ".join(broken) or "no script that trains a GaussianModel"
        fork.refuse("other-host", str(repo.root), found, "a *train*.py that makes GaussianModels")
    for script in fork.scripts:
        _check_script(fork, script)


def _networks(repo: HostRepo, script: str) -> set[str]:
    """Classes that a script imports and that save no PLY: they are no models of Gaussians."""
    return {
        node.name
        for tree in reading.reached(repo, [reading.module_of(script)], RENDERER).values()
        for node in tree.body
        if isinstance(node, ast.ClassDef)
        and node.name != CLASS
        and not node.bases[1:]
        and not any(getattr(each, "name", "") == "save_ply" for each in node.body)
        and not any(text_of(each).endswith(CLASS) for each in node.bases)
    }


def _check_script(fork: Fork, script: str) -> None:
    """A script trains in this process, and goes backward once in an iteration."""
    tree, refuse = fork.tree(script), partial(fork.refuse, "script", script)
    if _PROCESSES.search(text_of(tree)):
        refuse("it trains in processes of its own", "one process that keeps its files")
    owners = "|".join(map(re.escape, sorted(reading.owners(tree)))) or "-"
    if copied := re.search(rf"\bdeepcopy\(({owners})\)", text_of(tree)):
        refuse(f"copies its model, {copied[0]}", "the one that it makes")
    if size := _size(fork.repo, script):
        # a resumed training may begin with the first of its sizes again
        fork.one_run = f"{script} draws pictures of sizes that may change, {size}"
        fork.warn("script", script, f"the size of its pictures in stage 2, {size}")
    if several := _trainings(fork, reading.module_of(script)):
        refuse(*several)
    ways = [node for node, name in method_calls(tree) if name == "backward"]
    if ways and all(each in fork.optional for each in ways):
        only = sorted(frozenset().union(*(fork.optional[each] for each in ways)))
        refuse(f"it trains only with --{', --'.join(only)}", "a training by default")
    if any(_blind(function, fork.drawing) for function in reading.learning(tree)):
        refuse("a loss which learns nothing of its picture", "a loss of the picture")
    reached = reading.reached(fork.repo, [reading.module_of(script)], "scene").values()
    if not any(plain.SAVES.search(text_of(each)) for each in reached):
        refuse("it saves no PLY", "a script that saves its model")
    if until := _rests(tree):
        refuse(f"its optimizer steps only where {until}", "to its end")
    loops = [
        loop
        for loop in every(tree, ast.For)
        if any(name == "backward" for _, name in method_calls(loop))
    ]
    counted = [each for each in loops if "iterations" in text_of(each.iter)]
    if any(each in nodes(outer)[1:] for each in counted for outer in loops):
        refuse("a training in a loop", "one training")
    within = {each for loop in counted for each in nodes(loop)[1:]}
    if not within.isdisjoint(loops) and "several models" not in fork.one_run:
        refuse("goes backward several times in an iteration", "once, by which steps are counted")
    fork.one_run = fork.one_run or next(_not_resumed(fork.repo, script, tree), "")


def _size(repo: HostRepo, script: str) -> str:
    """What a script gives a drawing function for the size of its pictures; "" for nothing."""
    trees = reading.reached(repo, [reading.module_of(script)], RENDERER).values()
    calls = [each for tree in trees for each in every(tree, ast.Call)]
    for name in graphdeco.drawing_functions(repo, RENDERER):
        parameters = repo.parameters(RENDERER, name) or ()
        given = [call.given for call in graphdeco.read_calls(repo, RENDERER, name)]
        sizes = [each.get(key) for each in given for key in ("image_height", "image_width")]
        read = {each.id for size in sizes for each in every(size, ast.Name)}
        cameras = {each for each in parameters if CAMERA.match(each)} | {*parameters[:1]}
        for call in (each for each in calls if getattr(each.func, "id", "") == name):
            named = syntax.passed(call, parameters)
            for parameter in sorted((named.keys() & read) - cameras):
                if not is_off(named[parameter]):
                    return f"{parameter}={text_of(named[parameter])}"
    return ""


def _rests(tree: ast.Module) -> str:
    """Where alone a script steps its model's optimizer, with which thresholds step; "" if to its
    end.
    """
    models = reading.owners(tree)
    parts = under(tree, r"\biteration\b(?!.*\biterations\b)", both=True)
    called = [n for n, name in method_calls(tree) if name == "step"]
    steps = [n for n in called if text_of(n.func).removesuffix(".optimizer.step") in models]
    return parts[steps[0]] if steps and parts.keys() >= {*steps} else ""


def _blind(function: ast.FunctionDef, drawing: Collection[str]) -> bool:
    """Whether the loss that a function goes backward by is made of what it drew without the picture
    itself, as of objects alone.
    """
    made: dict[str, list[ast.expr]] = {}
    for more in every(function, ast.AugAssign):
        made.setdefault(text_of(more.target), []).append(more.value)
    for to, value in assigned(function):
        for each in getattr(to, "elts", [to]):
            made.setdefault(text_of(each), []).append(value)
    waiting: list[ast.AST] = [n.func for n, name in method_calls(function) if name == "backward"]
    blind = False
    for node in waiting:  # it grows
        key = getattr(getattr(node, "slice", None), "value", None)
        if key == "render" or getattr(getattr(node, "func", None), "id", "") in drawing:
            return False
        drawn = made.get(text_of(node.value), []) if isinstance(node, ast.Subscript) else []
        if isinstance(key, str) and any(isinstance(each, ast.Call) for each in drawn):
            blind = True
        else:
            waiting += [*made.pop(text_of(node), []), *ast.iter_child_nodes(node)]
    return blind


def _trainings(fork: Fork, module: str) -> tuple[str, str] | None:
    """What goes backward more than once in one pass of a script, and what is expected.

    Of two branches one is passed; what a function does counts where it is called.
    """
    body = getattr(fork.repo.tree(module), "body", ())
    functions = {each.name: each for each in body if isinstance(each, ast.FunctionDef)}
    training, several = set[str](), list[str]()

    def passes(node: ast.AST, looped: bool = False, asked: bool = False) -> int:
        if node in fork.optional and not asked:
            fork.options |= fork.optional[node] if passes(node, looped, True) else set()
            return 0
        if isinstance(node, ast.If):
            branches = (node.body, node.orelse)
            return max(sum(passes(each, looped, asked) for each in b) for b in branches)
        own = 0
        if isinstance(node, ast.Call):
            called = getattr(node.func, "id", "")
            own = (called in training) + (getattr(node.func, "attr", "") == "backward")
            if called in training and looped and every(functions[called], *LOOPS):
                several.append(called)
                own += 1
        looped |= isinstance(node, LOOPS)
        return own + sum(passes(each, looped, asked) for each in ast.iter_child_nodes(node))

    while found := {k for k, each in functions.items() if k not in training and passes(each)}:
        training |= found
    main = [each for each in body if each not in functions.values()]
    most = max(sum(map(passes, main)), *map(passes, functions.values()), 0)
    if most < 2:
        return None
    several += [each for each in training if len(fork.repo.calls(module, each)) > 1]
    if several:
        return f"several calls of {several[0]}, which trains", "one training"
    places = f"{most} places that go backward, perhaps in one iteration"
    return places, "one, by which steps are counted"


def _bound_at_first(tree: ast.Module) -> tuple[str, str] | None:
    """A name that a function binds only in its first iterations, and where; it reads it later."""
    for function in every(tree, ast.FunctionDef):
        early = under(function, r"(^|and )iteration (<|<=|==) \d+$")
        bound = [(name, node) for node in nodes(function) for name in failing.named([node])]
        first = {name: early[node] for name, node in bound if node in early}
        later = {name for name, node in bound if node not in early}
        for read in every(function, ast.Name):
            if read.id in first.keys() - later and read not in early:
                return read.id, first[read.id]
    return None


def _not_resumed(repo: HostRepo, script: str, tree: ast.Module) -> Iterator[str]:
    """Why a script cannot resume its own training, or we not read its checkpoints."""
    methods, text = methods_of(repo), text_of(tree)
    both = ("capture", "restore")
    missing = [name for each in (mentioned(tree), methods) for name in both if name not in each]
    if missing:
        yield f"{script} has no {' and no '.join(dict.fromkeys(missing))}"
        return
    if _EMPTIES.search(text):
        yield f"{script} removes its output folder"
    if not _CHECKPOINT.search(text):
        yield f"{script} has checkpoints of another name"
    saved = [node.args[0] for node, name in method_calls(tree) if name == "save" and node.args]
    kept = [each for each in saved if "capture()" in text_of(each)]
    if not any(isinstance(each, ast.Tuple) and len(each.elts) == 2 for each in kept):
        yield f"{script} has checkpoints that are not its model and the iteration"
    if bound := _bound_at_first(tree):
        yield f"{script} makes {bound[0]} only where {bound[1]}"
    made = every(tree, ast.Assign)
    assigned = [(node, text_of(target)) for node in made for target in node.targets]
    read = {
        name: node.lineno
        for node, names in assigned
        if "load(" in text_of(node.value) and "," in names
        for name in re.findall(r"\w+", names)
    }
    if any(node.lineno > read.get(name, node.lineno) for node, name in assigned):
        yield f"{script} does not go on at the iteration of its checkpoint"
    capture = methods["capture"]
    if not any("optimizer.state_dict()" in text_of(each) for each in reading.state(capture)):
        yield "its checkpoints have no state of an optimizer"
    if uneven := reading.uneven(capture, methods["restore"]):
        yield uneven
    for call, name in method_calls(methods["restore"]):
        own = methods.get(name) if text_of(call.func) == f"self.{name}" else None
        if why := failing.misfit(own, call, of_model=True):
            yield f"its restore calls {name}, and {why}"
    whole = re.findall(r"self\.(\w+)(?=[,)])", text_of(capture))
    trained = re.findall(r"self\.(\w+)\.parameters\(", text_of(repo.tree(MODEL)))
    if networks := sorted({*whole} & {*trained}):
        yield f"its checkpoints hold whole networks, {', '.join(networks)}"
    if networks := sorted({*trained} - mentioned(capture)):
        yield f"its checkpoints lack networks, {', '.join(networks)}"
    setup = text_of(methods.get("training_setup"))
    values = re.findall(r"'params': \[self\.(\w+)\]", setup)
    if lacking := sorted({*values} - mentioned(capture)):
        yield f"its checkpoints lack {', '.join(lacking)}"


def _in_loop(tree: ast.AST, name: str) -> bool:
    """Whether a class is called in a loop."""
    loops = every(tree, *LOOPS, ast.ListComp, ast.DictComp, ast.GeneratorExp)
    called = (each.func for loop in loops for each in every(loop, ast.Call))
    return any(getattr(each, "id", "") == name for each in called)
