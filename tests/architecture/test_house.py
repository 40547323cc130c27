"""The size of the house, counted from its source. A bound is lowered whenever the figure falls."""

import ast
from collections import Counter
from functools import cache
from graphlib import TopologicalSorter
from pathlib import Path
from types import FunctionType

import pytest

from fragprune_plugins.adapting import Dialect, HostAdapter, ScriptAdapter
from fragprune_plugins.plugins.points import load, offered
from fragprune_plugins.workbench.commands import GROUP

ROOT = Path(__file__).parents[2]
PRODUCT = ROOT / "fragprune_plugins"
FAMILY = ROOT / "adapters" / "fragprune_graphdeco"
HOST = PRODUCT / "workbench" / "demo" / "host"  # a program of its own
ENTRIES = ("injection.launch", "injection.api", "injection.workers", "adapting")
LAZY = (  # by name: in adapting.__getattr__, in engines.ENGINES
    *("files.model", "files.ply", "files.sidecar", "engines"),
    *("engines.reference", "engines.cpu.engine", "engines.cuda.engine"),
)

# figure: (bound, goal)
BOUNDS = {
    "core lines": (11_034, 12_000),
    "core imports of the workbench": (0, 0),
    "imports inside functions": (27, 60),
    "functions over 60 lines": (4, 10),
    "longest function": (68, 80),
    "members of an adapter": (24, 24),
    "members of a dialect": (7, 7),
    "members with one user": (3, 5),
    "options": (45, 45),
}


@cache
def sources() -> dict[str, Path]:
    """The product's modules by name, and their files."""
    files = (path for path in PRODUCT.rglob("*.py") if not path.is_relative_to(HOST))
    names = {path.relative_to(ROOT).with_suffix("").parts: path for path in files}
    return {".".join(parts).removesuffix(".__init__"): path for parts, path in names.items()}


@cache
def tree(path: Path) -> ast.Module:
    return ast.parse(path.read_text())


def imported(module: str, *, typing: bool = False) -> set[str]:
    """Modules of the product that a module imports, at its top or inside functions.

    Args:
        typing: also those that it imports for its types alone.
    """
    nodes = list(ast.walk(tree(sources()[module])))
    if not typing:
        tests = (node for node in nodes if isinstance(node, ast.If))
        checked = (each for each in tests if ast.unparse(each.test) == "TYPE_CHECKING")
        unread = {inner for each in checked for inner in ast.walk(each)}
        nodes = [node for node in nodes if node not in unread]
    found = set()
    for node in nodes:
        if isinstance(node, ast.Import):
            found |= {alias.name for alias in node.names}
        elif isinstance(node, ast.ImportFrom) and node.module:
            modules = {f"{node.module}.{alias.name}" for alias in node.names} & sources().keys()
            found |= modules if len(modules) == len(node.names) else {node.module, *modules}
    return found & sources().keys() - {module}


def core() -> set[str]:
    """Everything that a host run can load, adapters apart."""
    known: set[str] = set()
    waiting = [f"fragprune_plugins.{name}" for name in (*ENTRIES, *LAZY)]
    while waiting:
        module = waiting.pop()
        if module not in known:
            known.add(module)
            package = module.rpartition(".")[0]  # runs before its modules
            waiting += [*imported(module), *([package] if "." in package else [])]
    return known


def functions() -> list[ast.AST]:
    nodes = (node for path in sources().values() for node in ast.walk(tree(path)))
    return [node for node in nodes if isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef)]


def lengths() -> list[int]:
    return [node.end_lineno - node.lineno + 1 for node in functions()]


def lines_of_imports() -> int:
    inside = {
        node
        for function in functions()
        for node in ast.walk(function)
        if isinstance(node, ast.Import | ast.ImportFrom)
    }
    return len(inside)


def members(*kinds: type) -> set[str]:
    """Methods and properties that a subclass may define."""
    known = (item for kind in kinds for item in vars(kind).items())
    kinds_of = (FunctionType, property)
    return {name for name, value in known if isinstance(value, kinds_of) and name[0] != "_"}


def single_users() -> list[str]:
    """Methods and attributes of adapters and dialects that the adapters of one folder define.

    ``fragprune_graphdeco`` is no adapter: whoever inherits from it uses what it defines.
    """
    attributes = {
        name
        for kind in (HostAdapter, ScriptAdapter, Dialect)
        for name in kind.__annotations__.keys() | vars(kind).keys()
        if not name.startswith("_")
    }
    users: Counter[str] = Counter()
    for folder in sorted({*(ROOT / "adapters").iterdir()} - {FAMILY}):
        nodes = [node for path in folder.rglob("*.py") for node in ast.walk(tree(path))]
        classes = [node for node in nodes if isinstance(node, ast.ClassDef) and node.bases]
        defined: set[str] = set()
        for statement in (each for node in classes for each in node.body):
            if isinstance(statement, ast.FunctionDef):
                defined.add(statement.name)
            elif isinstance(statement, ast.Assign):
                defined |= {name.id for name in statement.targets if isinstance(name, ast.Name)}
        users.update(defined & attributes)
    return sorted(name for name, count in users.items() if count == 1)


def options() -> set[str]:
    """Options of all commands, by their names."""
    commands = [load(point) for point in offered(GROUP).values()]
    return {param.opts[0] for each in commands for param in each.params if param.opts[0][0] == "-"}


@cache
def figures() -> dict[str, int]:
    loaded = core()
    return {
        "core lines": sum(len(sources()[m].read_text().splitlines()) for m in loaded),
        "core imports of the workbench": len([m for m in loaded if ".workbench" in m]),
        "imports inside functions": lines_of_imports(),
        "functions over 60 lines": len([n for n in lengths() if n > 60]),
        "longest function": max(lengths()),
        "members of an adapter": len(members(HostAdapter, ScriptAdapter)),
        "members of a dialect": len(members(Dialect)),
        "members with one user": len(single_users()),
        "options": len(options()),
    }


@pytest.mark.parametrize("figure", BOUNDS)
def test_the_house_grows_no_further(figure):
    bound, _ = BOUNDS[figure]
    assert figures()[figure] <= bound


def test_no_two_modules_need_each_other():
    graph = {module: imported(module, typing=True) for module in sources()}
    TopologicalSorter(graph).prepare()  # raises CycleError, which names them


if __name__ == "__main__":
    for name, (bound, goal) in BOUNDS.items():
        print(f"{name}: {figures()[name]} (bound {bound}, goal {goal})")
    print(f"with one user: {', '.join(single_users())}")
