"""Reads what a fork of the 3DGS training code does: its scripts, draws, values and rows."""

from __future__ import annotations

import ast
import re
from collections.abc import Collection, Iterator
from dataclasses import dataclass, field
from functools import cached_property, lru_cache, partial
from typing import Any

import fragprune_graphdeco as graphdeco
from fragprune_3dgs_fork import rasterizer
from fragprune_3dgs_fork.rasterizer import Output
from fragprune_graphdeco import (
    Drawing,
    arguments,
    assigned,
    every,
    failing,
    kernels,
    reading,
    syntax,
    text_of,
)
from fragprune_plugins.adapting import Finding, Function, HostRepo, is_off, nodes, off_by_default

MODEL, CLASS, RENDERER = reading.MODEL, "GaussianModel", "gaussian_renderer"
PARAMETERS = {"_xyz", "_features_dc", "_features_rest", "_opacity", "_scaling", "_rotation"}
PRIMITIVES = {"_prune_optimizer", "cat_tensors_to_optimizer", "replace_tensor_to_optimizer"}
"""Methods that change rows or values of parameters inside the optimizer."""
CHECKPOINT = r"(?:chkpnt|ckpt|checkpoint)[_-]?"
"""How names of checkpoints begin, before the iteration."""
_CHECKPOINT = re.compile(
    rf"(^|[/'\"]){CHECKPOINT}(['\"] \+ str\(\w+\) \+ ['\"]|{{\w*(:\w+)?}}|%d)\.pth"
)
"""A checkpoint's name in a source: its beginning, the iteration and nothing else."""
_PROCESSES = re.compile(
    r"\bProcess\((.*\W)?target=|\bmp\.spawn\(|\b(DDP|DistributedDataParallel)\("
)
_RESUMES = re.compile(r"^(\w+\.)?(start_)?checkpoint( is not None)?$")
"""A test for a checkpoint to go on from."""
_EMPTIES = re.compile(r"\brmtree\(\w+\.model_path")
"""A script that removes its output folder, and with it the checkpoint to resume."""
STATISTICS = {"oneupSHdegree", "add_densification_stats"}
_MAKES = re.compile(r"__init__|capture\w*|(restore|create|load|init|set)_?\w*|\w*setup\w*")
"""Methods that make a model, before it is trained."""
_PARAMETER = re.compile(
    rf"(.+)\.({'|'.join(sorted(PARAMETERS))})(\.(?!grad\b|requires_grad\b)\w+|\[.*\])*"
)
"""A parameter of a model, or a part of it."""
_IN_PLACE = re.compile(r".+\.(?!_|requires_grad)\w+_", re.DOTALL)
"""A method that changes values in place."""
_OF_MODELS = re.compile(r"^scene\.\w*model\w*$")
_MODELS = re.compile(r"\b(gaussians?|pc|model)$")
"""What functions and scripts call a model that they are given."""
_OPTIMIZER = re.compile(r"(torch\.)?(optim\.)?\w*(Adam|SGD|RMSprop)\w*\(")
_CAMERA = re.compile(r"view|cam")
_LOOPS = (ast.For, ast.While)
_MODEL_ARGUMENTS = ("pc", "gaussians", "gaussian", "model")

_SET = {"iterations", "save_iterations", "checkpoint_iterations", "start_checkpoint", "model_path"}
"""Options that a run sets itself, whatever their defaults."""

NEUTRAL = {"antialiasing", "confidence", "projmatrix_raw"}
"""Further settings that the engines know, or that are checked to be neutral at every call."""
HANDED = ("detach", "clone", "contiguous", "squeeze", "unsqueeze")
"""Methods of a value that nobody reads yet: it is handed on in another shape."""
_PROVABLE = re.compile(r"^(?!.*(median|max|normal|var|dist)).*(depth|alpha|acc|opac)")
"""Names of values that a proof can tell, if they are what they are called."""


@dataclass(frozen=True)
class Draw:
    """A drawing function that a training script reaches, and its parameters of these kinds."""

    function: str
    camera: str
    model: str
    calls: tuple[graphdeco.CallInSource, ...]  # of a rasterizer, in source order


@dataclass
class Fork:
    """What was read of a checkout."""

    repo: HostRepo
    findings: list[Finding] = field(default_factory=list)  # errors: why it cannot be served
    scripts: tuple[str, ...] = ()  # that train, the usual one first
    unserved: dict[str, str] = field(default_factory=dict)  # others that do, with the reason
    draws: tuple[Draw, ...] = ()
    outputs: dict[str, tuple[Output, ...]] = field(default_factory=dict)  # by rasterizer's package
    still: tuple[str, ...] = ()  # methods of the model that scripts call, and that change it
    answering: frozenset[str] = frozenset()  # those whose result they read, while they densify
    setups: tuple[str, ...] = ()  # methods that make the optimizer
    # by package, the argument with channels that are blended beside the colours
    blended: dict[str, str] = field(default_factory=dict)
    # off by default: scripts then draw by other functions, change the model, read unknown values,
    # or take the other options from a file
    options: frozenset[str] = frozenset()
    off: frozenset[str] = frozenset()  # what rasterizers take that is None or False by default
    scaled: frozenset[str] = frozenset()  # settings that change the gradient on the screen alone
    asking: frozenset[str] = frozenset()  # settings without which no channels are blended
    one_run: str = ""  # why a script cannot resume its own training; "" if all of them can
    screens: frozenset[str] = frozenset()  # arguments that get a gradient on the screen, too
    colours: frozenset[str] = frozenset()  # options, off by default, by which networks colour
    noisy: bool = False  # scripts move positions by noise, as large as their rate

    def warn(self, code: str, where: str, found: str) -> None:
        """Add a warning, once for all places."""
        if all(each.found != found for each in self.findings):
            self.findings.append(Finding("warning", code, where, found))

    @property
    def command(self) -> tuple[str, ...]:
        """The modules that give the options of the command their defaults."""
        return ("arguments", *map(reading.module_of, self.scripts))

    def tree(self, script: str) -> ast.Module:
        """The tree of a script."""
        return self.repo.tree(reading.module_of(script)) or ast.Module([], [])

    def default(self, option: str) -> str | None:
        """An option's default, as a command gives it; None if it is not known."""
        known = reading.by_default_of(self.repo, self.command, option)
        return str(known[0]) if known else None

    def refuse(self, code: str, where: str, found: str, expected: str) -> None:
        """Add an error."""
        self.findings.append(Finding.error(code, where, found, expected))

    @property
    def errors(self) -> list[Finding]:
        """Why it cannot be served."""
        return [each for each in self.findings if each.level == "error"]

    @cached_property
    def settings(self) -> dict[str, tuple[str, ...]]:
        """Names of the settings, by rasterizer, also of those that no script reaches."""
        found: dict[str, tuple[str, ...]] = {}
        for name in self.drawing:
            for call in graphdeco.read_calls(self.repo, RENDERER, name):
                found.setdefault(call.package, call.settings)
        return found | {call.package: call.settings for draw in self.draws for call in draw.calls}

    # -- modules ----------------------------------------------------------------------------------

    @cached_property
    def trees(self) -> dict[str, ast.Module]:
        """The scripts and the checkout's own modules that they import, without model and draws."""
        seen = reading.reached(self.repo, map(reading.module_of, self.scripts), RENDERER)
        return {each: tree for each, tree in seen.items() if not _OF_MODELS.search(each)}

    @cached_property
    def drawing(self) -> list[str]:
        """The functions that draw."""
        return graphdeco.drawing_functions(self.repo, RENDERER)

    @cached_property
    def optional(self) -> dict[ast.AST, frozenset[str]]:
        """What scripts do only under options that are off by default, with their names.

        Without those that a run sets, or the checkout itself, as it may all of them from a file.
        """
        found: dict[ast.AST, frozenset[str]] = {}
        if any("setattr(" in text_of(self.tree(each)) for each in self.scripts):
            return found
        own = (tree for name, tree in self.trees.items() if name.split(".")[0] != "arguments")
        pairs = (pair for each in own for pair in assigned(each))
        made = _SET | {to.attr for to, _ in pairs if isinstance(to, ast.Attribute)}
        known = reading.as_options(self.repo, self.command)
        for tree in self.trees.values():
            skipped = syntax.skipped(tree, known)
            named = {each: reading.options_of(each, known) for each in {*skipped.values()}}
            under = {node: named[test] for node, test in skipped.items()}
            found |= {node: names for node, names in under.items() if made.isdisjoint(names)}
        return found

    @cached_property
    def early(self) -> set[ast.AST]:
        """What scripts do only while they densify, with the functions that they need only then."""
        trees = self.trees.values()
        early = {node for script in self.scripts for node in _while_densifying(self.tree(script))}
        made = [each for tree in trees for each in every(tree, ast.FunctionDef)]
        named: dict[str, list[ast.AST]] = {each.name: [] for each in made}
        for node in (node for tree in trees for node in every(tree, ast.Name, ast.Attribute)):
            named.get(getattr(node, "id", getattr(node, "attr", "")), []).append(node)
        while more := [
            each
            for each in made
            if each not in early and named[each.name] and early.issuperset(named[each.name])
        ]:
            early |= {node for each in more for node in nodes(each)}
        return early


@lru_cache(maxsize=16)
def read_fork(repo: HostRepo) -> Fork:
    """Read a checkout, once; of several scripts only those that can be served, if one can."""
    fork = _read(repo, reading.training_scripts(repo, *reading.SCRIPTS, "*/*train*.py"))
    if fork.errors and len(fork.scripts) > 1:
        alone = {script: _read(repo, (script,)) for script in fork.scripts}
        refused = {name: each.errors[0].found for name, each in alone.items() if each.errors}
        if served := tuple(script for script in alone if script not in refused):
            unserved, fork = fork.unserved | refused, _read(repo, served)
            fork.unserved = unserved
    for script, why in fork.unserved.items() if fork.scripts else ():
        fork.warn("script", script, f"{script}, which is not served: {why}")
    return fork


def _read(repo: HostRepo, scripts: tuple[str, ...]) -> Fork:
    fork = Fork(repo)
    _read_scripts(fork, scripts)
    if fork.scripts:
        _read_methods(fork)
        _read_draws(fork)
        _read_outputs(fork)
        _read_changes(fork)
    return fork


# -- scripts ---------------------------------------------------------------------------------------


def _read_scripts(fork: Fork, scripts: tuple[str, ...]) -> None:
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
        found = f"draws pictures of another size than the camera's, {size}"
        refuse(found, "the camera's: stage 2 would begin with the first of its sizes again")
    if several := _trainings(fork, reading.module_of(script)):
        refuse(*several)
    if until := _rests(tree):
        refuse(f"its optimizer steps only where {until}", "to its end")
    loops = [
        loop
        for loop in every(tree, ast.For)
        if any(name == "backward" for _, name in _method_calls(loop))
    ]
    counted = [each for each in loops if "iterations" in text_of(each.iter)]
    if any(each in nodes(outer)[1:] for each in counted for outer in loops):
        refuse("a training in a loop", "one training")
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
        cameras = {each for each in parameters if _CAMERA.match(each)} | {*parameters[:1]}
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
    parts = _under(tree, r"\biteration\b(?!.*\biterations\b)", both=True)
    called = [n for n, name in _method_calls(tree) if name == "step"]
    steps = [n for n in called if text_of(n.func).removesuffix(".optimizer.step") in models]
    return parts[steps[0]] if steps and parts.keys() >= {*steps} else ""


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
            if called in training and looped and every(functions[called], *_LOOPS):
                several.append(called)
                own += 1
        looped |= isinstance(node, _LOOPS)
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
        early = _under(function, r"(^|and )iteration (<|<=|==) \d+$")
        bound = [(name, node) for node in nodes(function) for name in _binds(node)]
        first = {name: early[node] for name, node in bound if node in early}
        later = {name for name, node in bound if node not in early}
        for read in every(function, ast.Name):
            if read.id in first.keys() - later and read not in early:
                return read.id, first[read.id]
    return None


def _binds(node: ast.AST) -> list[str]:
    """Names that a node of a function binds."""
    if isinstance(node, ast.Import | ast.ImportFrom):
        return [(each.asname or each.name).split(".")[0] for each in node.names]
    if isinstance(node, ast.arg):
        return [node.arg]
    return [node.id] if isinstance(node, ast.Name) and isinstance(node.ctx, ast.Store) else []


def _not_resumed(repo: HostRepo, script: str, tree: ast.Module) -> Iterator[str]:
    """Why a script cannot resume its own training, or we not read its checkpoints."""
    methods, text = _methods(repo), text_of(tree)
    both = ("capture", "restore")
    missing = [name for each in (_mentioned(tree), methods) for name in both if name not in each]
    if missing:
        yield f"{script} has no {' and no '.join(dict.fromkeys(missing))}"
        return
    if _EMPTIES.search(text):
        yield f"{script} removes its output folder"
    if not _CHECKPOINT.search(text):
        yield f"{script} has checkpoints of another name"
    saved = [node.args[0] for node, name in _method_calls(tree) if name == "save" and node.args]
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
    whole = re.findall(r"self\.(\w+)(?=[,)])", text_of(capture))
    trained = re.findall(r"self\.(\w+)\.parameters\(", text_of(repo.tree(MODEL)))
    if networks := sorted({*whole} & {*trained}):
        yield f"its checkpoints hold whole networks, {', '.join(networks)}"
    if networks := sorted({*trained} - _mentioned(capture)):
        yield f"its checkpoints lack networks, {', '.join(networks)}"
    setup = text_of(methods.get("training_setup"))
    values = re.findall(r"'params': \[self\.(\w+)\]", setup)
    if lacking := sorted({*values} - _mentioned(capture)):
        yield f"its checkpoints lack {', '.join(lacking)}"


def rests_after_densification(fork: Fork) -> bool:
    """Whether scripts change the model only where they ask for ``densify_until_iter``."""
    return not any(
        name in fork.still and name != "oneupSHdegree" and node not in _while_densifying(tree)
        for tree in map(fork.tree, fork.scripts)
        for node, name in _method_calls(tree)
    )


@lru_cache(maxsize=256)
def _under(tree: ast.AST, pattern: str, both: bool = False) -> dict[ast.AST, str]:
    """What is done only where a test of this pattern holds, with the test; or wherever it is asked
    for.
    """
    found: dict[ast.AST, str] = {}
    for node in every(tree, ast.If):
        if re.search(pattern, test := text_of(node.test)):
            parts = (*node.body, *(node.orelse if both else ()))
            found |= {inner: test for each in parts for inner in nodes(each)}
    return found


@lru_cache(maxsize=256)
def _while_densifying(tree: ast.AST) -> Collection[ast.AST]:
    """What a script does only where it asks for ``densify_until_iter``, or has no checkpoint."""
    new = (each.orelse for each in every(tree, ast.If) if _RESUMES.search(text_of(each.test)))
    first = {inner for part in new for each in part for inner in nodes(each)}
    return _under(tree, "densify_until_iter").keys() | first


def _in_loop(tree: ast.AST, name: str) -> bool:
    """Whether a class is called in a loop."""
    loops = every(tree, *_LOOPS, ast.ListComp, ast.DictComp, ast.GeneratorExp)
    called = (each.func for loop in loops for each in every(loop, ast.Call))
    return any(getattr(each, "id", "") == name for each in called)


@lru_cache(maxsize=256)
def _mentioned(tree: ast.AST) -> frozenset[str]:
    """Names, attributes and imports in a tree."""
    return frozenset(
        getattr(node, kind)
        for node in nodes(tree)
        for kind in ("id", "attr", "name")
        if isinstance(getattr(node, kind, None), str)
    )


def _method_calls(tree: ast.AST) -> Iterator[tuple[ast.Call, str]]:
    for node in every(tree, ast.Call):
        if isinstance(node.func, ast.Attribute):
            yield node, node.func.attr


# -- the model's methods ---------------------------------------------------------------------------


def _methods(repo: HostRepo) -> dict[str, Function]:
    body = getattr(repo.definition(MODEL, CLASS), "body", ())
    return {each.name: each for each in body if isinstance(each, ast.FunctionDef)}


def _read_methods(fork: Fork) -> None:
    """Methods that change the model, and those of them that scripts call."""
    methods = _methods(fork.repo)
    known = (STATISTICS | PRIMITIVES) & methods.keys()
    changing = known | {name for name, body in methods.items() if any(_assigned(body, "self"))}
    called = {name: {each for _, each in _method_calls(body)} for name, body in methods.items()}
    while more := {name for name in called.keys() - changing if called[name] & changing}:
        changing |= more
    fork.setups = tuple(
        name
        for name, body in methods.items()
        if "self.optimizer" in {text_of(to) for to, _ in assigned(body)} and name != "__init__"
    )
    loops = [each for script in fork.scripts for each in every(fork.tree(script), *_LOOPS)]
    trained = {name for each in loops for _, name in _method_calls(each)}
    changing -= {each for each in changing if _MAKES.fullmatch(each)} - (trained - set(fork.setups))
    still = set[str]()
    for module, tree in fork.trees.items():
        owners = reading.owners(tree)
        statements = {each.value for each in every(tree, ast.Expr)}
        for node, name in ((node, name) for node, name in _method_calls(tree) if name in changing):
            still |= {name}
            owner = text_of(node.func.value)  # type: ignore[attr-defined]
            own = _MODELS.search(owner) or owner.split("[")[0] in owners
            if not own or node in statements:
                continue
            if node in fork.optional:
                fork.options |= fork.optional[node]
            elif node in fork.early:
                fork.answering |= {name}
            else:
                at = fork.repo.at(module, node.lineno)
                fork.refuse("row-change", at, f"reads what {name} returns", "a statement")
    fork.still = tuple(name for name in methods if name in still)
    save = methods.get("save_ply", ast.Pass())
    steps = {name for node, name in _method_calls(save) if text_of(node.func) == f"self.{name}"}
    if steps & changing or any(_assigned(save, "self")):
        place = fork.repo.place(MODEL, f"{CLASS}.save_ply")
        fork.refuse("row-change", place, "save_ply changes the model that it writes", "none")
    keeps = methods.get("_prune_optimizer")
    if keeps is not None and "[mask]" not in text_of(keeps):
        place = fork.repo.place(MODEL, f"{CLASS}._prune_optimizer")
        found = "_prune_optimizer keeps other rows than its mask's"
        fork.refuse("row-change", place, found, "[mask]")


def plain_distances(repo: HostRepo) -> bool:
    """Whether ``distCUDA2`` gives one tensor, as that of 3DGS does; forks also get neighbours."""
    tree = repo.tree(MODEL)
    taken = [each.value for each in every(tree, ast.Subscript)]
    taken += [value for target, value in assigned(tree) if isinstance(target, ast.Tuple)]
    return not any(text_of(each).startswith("distCUDA2(") for each in taken)


def _assigned(body: ast.AST, owner: str = "") -> Iterator[tuple[ast.AST, str]]:
    """What assigns a parameter of a model, or changes its values in place."""
    kinds = (ast.Assign, ast.AugAssign, ast.AnnAssign, ast.Call)
    changing: tuple[Any, ...] = every(body, *kinds)
    for node in changing:
        targets: list[ast.expr] = []
        if isinstance(node, ast.Assign):
            targets = node.targets
        elif isinstance(node, ast.AugAssign | ast.AnnAssign):
            targets = [node.target]
        elif isinstance(node, ast.Call) and _IN_PLACE.fullmatch(text_of(node.func)):
            targets = [node.func.value]  # type: ignore[attr-defined]
        for target in targets:
            for each in target.elts if isinstance(target, ast.Tuple) else [target]:
                found = _PARAMETER.fullmatch(text_of(each))
                if found and owner in ("", found[1]):
                    yield node, found[2]


def _read_changes(fork: Fork) -> None:
    """A script that changes parameters itself cannot be held still in stage 2."""
    for module, tree in fork.trees.items():
        noisy = _noisy(tree)
        fork.noisy |= bool(noisy)
        for node, name in _assigned(tree):
            at = fork.repo.at(module, node.lineno)  # type: ignore[attr-defined]
            if node in fork.optional:
                fork.options |= fork.optional[node]
            elif node in fork.early:
                fork.warn("row-change", at, f"that {at}, which changes {name}, ends before stage 2")
            elif node not in noisy:
                fork.refuse("row-change", at, f"changes {name} outside the model's methods", "none")
    for script in fork.scripts:
        trained, module = fork.tree(script), reading.module_of(script)
        owners = reading.owners(trained)
        for node in every(trained, ast.Assign, ast.Call):
            at = fork.repo.at(module, node.lineno)  # type: ignore[attr-defined]
            if isinstance(node, ast.Assign) and _OPTIMIZER.match(text_of(node.value)):
                name = text_of(node.targets[0])
            elif isinstance(node, ast.Call) and text_of(node.func).endswith("optimizer.step"):
                name = text_of(node.func).removesuffix(".step")
                owner = name.rpartition(".")[0]
                if len(node.args) == 1:  # two are those of a sparse Adam
                    found = f"another optimizer, {text_of(node)[:60]}"
                    fork.refuse("optimizer", at, found, "step()")
                if _MODELS.search(owner) or owner.split("[")[0] in {"", *owners}:
                    continue
            else:
                continue
            fork.warn("optimizer", at, f"stage 2 does not freeze what {name} of {script} trains")
            if f"{name}.load_state_dict(" not in text_of(trained):
                fork.one_run = fork.one_run or f"{script} does not resume what {name} trains"


def _noisy(tree: ast.AST) -> set[ast.AST]:
    """What adds a product with the rate of positions to them, as MCMC adds its noise."""
    made: dict[str, list[ast.expr]] = {}
    for to, value in assigned(tree):
        made.setdefault(text_of(to), []).append(value)
    rates = [to for to, (value, *_) in made.items() if ".update_learning_rate(" in text_of(value)]

    def product(value: ast.expr) -> bool:
        """Whether a rate is a factor."""
        return text_of(value) in rates or (
            isinstance(value, ast.BinOp)
            and isinstance(value.op, ast.Mult)
            and (product(value.left) or product(value.right))
        )

    def scaled(name: str) -> bool:
        """Whether products are all that goes by a name; it may be turned by a matrix then."""
        values = made.get(name, [])
        fresh = [each for each in values if name not in _mentioned(each)]
        return bool(fresh) and all(map(product, fresh))

    return {
        node
        for node, name in _method_calls(tree)
        if name == "add_" and len(node.args) == 1 and scaled(getattr(node.args[0], "id", ""))
    }


def read_getters(fork: Fork) -> list[Finding]:
    """Errors of the model's getters. They may give something else where an attribute is set that
    is None at first, if no method that scripts reach sets it, and nothing beside the model.
    """
    methods = _methods(fork.repo)
    reached = {name for tree in fork.trees.values() for _, name in _method_calls(tree)}
    while more := {
        called
        for name in reached & methods.keys()
        for _, called in _method_calls(methods[name])
        if called in methods and called not in reached
    }:
        reached |= more
    own = (methods[name] for name in (reached & methods.keys()) - {"__init__"})
    made = {
        target.attr
        for tree in (*own, *fork.trees.values(), fork.repo.tree(RENDERER))
        for target, value in assigned(tree)
        if isinstance(target, ast.Attribute) and not is_off(value)
    }
    return reading.read_getters(fork.repo, reading.unset(reading.ModelClass(fork.repo)) - made)


# -- draws -----------------------------------------------------------------------------------------


def _read_draws(fork: Fork) -> None:
    """The drawing functions that a script names, and their calls."""
    functions, repo = fork.drawing, fork.repo
    drawing = [each for each in fork.trees.values() if not _mentioned(each).isdisjoint(functions)]
    named = {name for tree in drawing for name in _reached(fork, tree)}
    pairs = ((name, repo.function(RENDERER, name)) for name in functions)
    drawn = {name: body for name, body in pairs if body}
    while more := {n for name in drawn.keys() & named for n in _mentioned(drawn[name])} - named:
        named |= more
    bodies = {name: body for name, body in drawn.items() if name in named}
    trees = (*fork.trees.values(), *bodies.values())
    called = {getattr(n, "id", getattr(n, "attr", "")) for each in trees for n in nodes(each)}
    for name, body in bodies.items():
        parameters = repo.parameters(RENDERER, name) or ()
        model = next((each for each in _MODEL_ARGUMENTS if each in parameters), "")
        at = f"{RENDERER}:{name} ({repo.place(RENDERER, name)})"
        refuse = partial(fork.refuse, "rasterizer-call", at)
        calls = tuple(graphdeco.read_calls(repo, RENDERER, name))
        others = [each for each in parameters if each != model]
        camera = next((each for each in others if _CAMERA.match(each)), next(iter(others), ""))
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
        for node in every(body, ast.Call) if name in called else ():
            if "means3D" in arguments(node):
                other = Drawing(repo, RENDERER, body, call=node)
                for found in (why for why, moves in other.shapes() if not moves):
                    refuse(found, "the model's own Gaussians")
                if selected := other.selection():
                    refuse(f"draws a selection, {selected}", "all rows")
        for cut in [*source.cuts()][:1]:
            refuse(f"a picture of more channels, {text_of(cut)}", "a picture")
        fork.colours |= source.colours
    if not fork.draws and not any(each.code == "rasterizer-call" for each in fork.findings):
        at = f"{RENDERER} ({repo.place(RENDERER, 'render')})"
        fork.refuse("rasterizer-call", at, "no drawing function that a script calls", "render")


def _reached(fork: Fork, node: ast.AST) -> Iterator[str]:
    """Names and imports in a script, without those under an option that is off by default."""
    for kind in ("id", "attr", "name"):
        if isinstance(name := getattr(node, kind, None), str):
            yield name
    for each in ast.iter_child_nodes(node):
        if each in fork.optional:
            if not _mentioned(each).isdisjoint(fork.drawing):
                fork.options |= fork.optional[each]
            continue
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
    unknown = {each for each in further if not _stays_off(fork, function, call.given.get(each))}
    fork.off |= {*further} - unknown
    for name in sorted(unknown & call.besides):
        changed = rasterizer.changed_gradients(fork.repo, call.package, name)
        if rasterizer.only_asks(fork.repo, call.package, name):
            unknown.remove(name)
            fork.asking |= {name}
        elif changed is not None and changed <= {"means2D"}:
            unknown.remove(name)
            fork.scaled |= {name}
            fork.warn("rasterizer-call", at, f"the gradient on the screen, which {name} changes")
    if unknown:
        found = f"{', '.join(sorted(unknown))}, unknown to fragprune"
        fork.refuse("rasterizer-call", at, found, "settings and arguments whose effect is known")


def _stays_off(fork: Fork, function: str, value: ast.expr | None) -> bool:
    """Whether a value is None or False unless a user asks for more; every call is checked."""
    body = fork.repo.function(RENDERER, function)
    if isinstance(value, ast.Attribute):
        return reading.off_in(fork.repo, (MODEL, *fork.command), value.attr)
    if not isinstance(value, ast.Name) or body is None:
        return is_off(value)
    names = fork.repo.parameters(RENDERER, function) or ()
    if value.id not in off_by_default(body):
        return False
    calls = [node for tree in fork.trees.values() for node in every(tree, ast.Call)]
    own = [getattr(each.func, "id", "") == function for each in calls]
    given = [syntax.passed(each, names if by else ()) for each, by in zip(calls, own, strict=True)]
    return all(_stays_off(fork, "", each.get(value.id, ast.Constant(None))) for each in given)


# -- outputs ---------------------------------------------------------------------------------------


def _read_outputs(fork: Fork) -> None:
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
        fork.warn(
            "rasterizer-output",
            at,
            f"{name}, by which it densifies and which only its own rasterizer gives",
        )
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
        still = (node for node, method in _method_calls(tree) if method in fork.still)
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
