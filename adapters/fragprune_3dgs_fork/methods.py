"""Reads the methods of a fork's model: which change rows and values, and who calls them."""

from __future__ import annotations

import ast
import re
from collections.abc import Iterator
from typing import Any

from fragprune_3dgs_fork.fork import (
    CLASS,
    LOOPS,
    MODEL,
    RENDERER,
    Fork,
    method_calls,
    methods_of,
    while_densifying,
)
from fragprune_graphdeco import assigned, every, is_off, mentioned, reading, text_of
from fragprune_plugins.adapting import Finding, HostRepo

PARAMETERS = {"_xyz", "_features_dc", "_features_rest", "_opacity", "_scaling", "_rotation"}
PRIMITIVES = {"_prune_optimizer", "cat_tensors_to_optimizer", "replace_tensor_to_optimizer"}
"""Methods that change rows or values of parameters inside the optimizer."""
RELOCATES = "replace_tensors_to_optimizer"
"""By which 3DGS-MCMC's methods that overwrite rows end."""
STATISTICS = {"oneupSHdegree", "add_densification_stats"}
_MAKES = re.compile(r"__init__|capture\w*|(restore|create|load|init|set)_?\w*|\w*setup\w*")
"""Methods that make a model, before it is trained."""
_PARAMETER = re.compile(
    rf"(.+)\.({'|'.join(sorted(PARAMETERS))})(\.(?!grad\b|requires_grad\b)\w+|\[.*\])*"
)
"""A parameter of a model, or a part of it."""
_GRADIENT = re.compile(rf"self\.({'|'.join(sorted(PARAMETERS))})\.grad[.\[]")
"""A parameter's gradient, which stage 2 does not compute."""
_IN_PLACE = re.compile(r".+\.(?!_|requires_grad)\w+_", re.DOTALL)
"""A method that changes values in place."""
_MODELS = re.compile(r"\b(gaussians?|pc|model)$")
"""What functions and scripts call a model that they are given."""


def rests_after_densification(fork: Fork) -> bool:
    """Whether scripts change the model only where they ask for ``densify_until_iter``."""
    return not any(
        name in fork.still and name != "oneupSHdegree" and node not in while_densifying(tree)
        for tree in map(fork.tree, fork.scripts)
        for node, name in method_calls(tree)
    )


def read_methods(fork: Fork) -> None:
    """Methods that change the model, and those of them that scripts call."""
    methods = methods_of(fork.repo)
    known = (STATISTICS | PRIMITIVES) & methods.keys()
    changing = known | {name for name, body in methods.items() if any(_assigned(body, "self"))}
    called = {name: {each for _, each in method_calls(body)} for name, body in methods.items()}
    while more := {name for name in called.keys() - changing if called[name] & changing}:
        changing |= more
    fork.setups = tuple(
        name
        for name, body in methods.items()
        if "self.optimizer" in {text_of(to) for to, _ in assigned(body)} and name != "__init__"
    )
    loops = [each for script in fork.scripts for each in every(fork.tree(script), *LOOPS)]
    trained = {name for each in loops for _, name in method_calls(each)}
    changing -= {each for each in changing if _MAKES.fullmatch(each)} - (trained - set(fork.setups))
    still = set[str]()
    for module, tree in fork.trees.items():
        owners = reading.owners(tree)
        statements = {each.value for each in every(tree, ast.Expr)}
        for node, name in ((node, name) for node, name in method_calls(tree) if name in changing):
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
    texts = ((name, text_of(body)) for name, body in methods.items() if name not in changing)
    graded = {name for name, text in texts if _GRADIENT.search(text) and ".grad is " not in text}
    for module, tree in fork.trees.items():
        calls = ((node, name) for node, name in method_calls(tree) if name in graded)
        for node, name in calls:
            if node in fork.optional:
                fork.options |= fork.optional[node]
            elif node not in fork.early:
                at = fork.repo.at(module, node.lineno)
                fork.refuse("row-change", at, f"{name} reads gradients of the model", "none")
    fork.still = tuple(name for name in methods if name in still)
    fork.relocating = frozenset(name for name in still if RELOCATES in called.get(name, ()))
    save = methods.get("save_ply", ast.Pass())
    steps = {name for node, name in method_calls(save) if text_of(node.func) == f"self.{name}"}
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


def read_changes(fork: Fork) -> None:
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
            if isinstance(node, ast.Assign) and reading.OPTIMIZER.match(text_of(node.value)):
                name = text_of(node.targets[0])
            elif isinstance(node, ast.Call) and text_of(node.func).endswith("optimizer.step"):
                name = text_of(node.func).removesuffix(".step")
                owner = name.rpartition(".")[0]
                if optional := fork.optional.get(node):
                    fork.options |= optional
                elif len(node.args) == 1:  # two are those of a sparse Adam
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
        fresh = [each for each in values if name not in mentioned(each)]
        return bool(fresh) and all(map(product, fresh))

    def noise(value: ast.expr) -> bool:
        """Whether such a name is added, or a product with it."""
        times = isinstance(value, ast.BinOp) and isinstance(value.op, ast.Mult)
        factors = (value.left, value.right) if times else (value,)  # type: ignore[attr-defined]
        return any(scaled(getattr(each, "id", "")) for each in factors)

    return {
        node
        for node, name in method_calls(tree)
        if name == "add_" and len(node.args) == 1 and noise(node.args[0])
    }


def read_getters(fork: Fork) -> list[Finding]:
    """Errors of the model's getters. They may give something else where an attribute is set that
    is None at first, if no method that scripts reach sets it, and nothing beside the model.
    """
    methods = methods_of(fork.repo)
    reached = {name for tree in fork.trees.values() for _, name in method_calls(tree)}
    while more := {
        called
        for name in reached & methods.keys()
        for _, called in method_calls(methods[name])
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
