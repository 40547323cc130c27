"""What is known of a fork of the 3DGS training code."""

from __future__ import annotations

import ast
import re
from collections.abc import Collection, Iterator
from dataclasses import dataclass, field
from functools import cached_property, lru_cache

import fragprune_graphdeco as graphdeco
from fragprune_3dgs_fork.rasterizer import Output
from fragprune_graphdeco import assigned, every, failing, reading, syntax, text_of
from fragprune_plugins.adapting import Finding, Function, HostRepo, nodes

MODEL, CLASS, RENDERER = reading.MODEL, "GaussianModel", "gaussian_renderer"
CHECKPOINT = r"(?:chkpnt|ckpt|checkpoint)[_-]?"
"""How names of checkpoints begin, before the iteration."""
_RESUMES = re.compile(r"^(\w+\.)?(start_)?checkpoint( is not None)?$")
"""A test for a checkpoint to go on from."""
_OF_MODELS = re.compile(r"^scene\.\w*model\w*$")
CAMERA = re.compile(r"view|cam")
LOOPS = (ast.For, ast.While)
_SET = {"iterations", "save_iterations", "checkpoint_iterations", "start_checkpoint", "model_path"}
"""Options that a run sets itself, whatever their defaults."""


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
    relocating: frozenset[str] = frozenset()  # those that overwrite rows by copies of others
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
        for tree in self.trees.values():
            called = failing.named_once(tree)
            known = reading.as_options(self.repo, self.command, called)
            skipped = syntax.skipped(tree, known)
            named = {each: reading.options_of(each, known, called) for each in {*skipped.values()}}
            under = {node: named[test] for node, test in skipped.items()}
            found |= {node: names for node, names in under.items() if made.isdisjoint(names)}
        return found

    @cached_property
    def early(self) -> set[ast.AST]:
        """What scripts do only while they densify, with the functions that they need only then."""
        trees = self.trees.values()
        early = {node for script in self.scripts for node in while_densifying(self.tree(script))}
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


@lru_cache(maxsize=256)
def under(tree: ast.AST, pattern: str, both: bool = False) -> dict[ast.AST, str]:
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
def while_densifying(tree: ast.AST) -> Collection[ast.AST]:
    """What a script does only where it asks for ``densify_until_iter``, or has no checkpoint."""
    new = (each.orelse for each in every(tree, ast.If) if _RESUMES.search(text_of(each.test)))
    first = {inner for part in new for each in part for inner in nodes(each)}
    return under(tree, "densify_until_iter").keys() | first


def method_calls(tree: ast.AST) -> Iterator[tuple[ast.Call, str]]:
    """Calls of methods, with the methods' names."""
    for node in every(tree, ast.Call):
        if isinstance(node.func, ast.Attribute):
            yield node, node.func.attr


def methods_of(repo: HostRepo) -> dict[str, Function]:
    """The methods of its model, by name."""
    body = getattr(repo.definition(MODEL, CLASS), "body", ())
    return {each.name: each for each in body if isinstance(each, ast.FunctionDef)}
