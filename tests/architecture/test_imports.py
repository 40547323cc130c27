"""What may be imported by whom, and what importing costs."""

import ast
import re
import shutil
import subprocess
import sys
from importlib import import_module
from importlib.metadata import entry_points, version
from importlib.util import find_spec
from pathlib import Path

import pytest

import fragprune_plugins
from fragprune_plugins import adapting
from fragprune_plugins.plugins.loading import load_plugins
from fragprune_plugins.workbench import bridge as bridge_command

ROOT = Path(__file__).parents[2]
ADAPTERS = sorted(p.name for p in (ROOT / "adapters").glob("fragprune_*") if p.is_dir())
PACKAGES = ["fragprune_plugins", "reference_renderer", *ADAPTERS]
HOST = ROOT / "fragprune_plugins" / "workbench" / "demo" / "host"  # a program of its own
INSIDE = {  # run inside an installed host alone, which imports them
    "fragprune_nerfstudio.method": "nerfstudio",
    "fragprune_nerfstudio.model": "nerfstudio",
}


def modules(package: str) -> list[str]:
    folder = Path(find_spec(package).origin).parent
    return sorted(
        ".".join(path.relative_to(folder.parent).with_suffix("").parts).removesuffix(".__init__")
        for path in folder.rglob("*.py")
        if not path.is_relative_to(HOST)
    )


def imported(package: str) -> set[str]:
    """Names of all modules that a package's source imports, wherever it does."""
    folder = Path(find_spec(package).origin).parent
    nodes = [
        node
        for path in folder.rglob("*.py")
        if not path.is_relative_to(HOST)
        for node in ast.walk(ast.parse(path.read_text()))
    ]
    return {
        *(alias.name for node in nodes if isinstance(node, ast.Import) for alias in node.names),
        *(node.module or "" for node in nodes if isinstance(node, ast.ImportFrom)),
    }


MODULES = [
    module
    for package in PACKAGES
    for module in modules(package)
    if module not in INSIDE or find_spec(INSIDE[module])
]


def test_the_outer_rooms_import_without_torch(python):
    core = (
        "adapting constants errors types hosts.adapter hosts.choosing hosts.dialect hosts.seams "
        "hosts.source injection.patching learning.pressure learning.schedule "
        "plugins.hookspecs plugins.loading files.atomic"
    )
    light = [
        *(
            module
            for module in MODULES
            if module.startswith("fragprune_plugins.workbench.commands.")
            and not module.endswith(".opening")  # what the work opens
        ),
        *(point.module for point in entry_points(group="fragprune.commands")),
        *(f"fragprune_plugins.{name}" for name in core.split(" ")),
        *ADAPTERS,
    ]
    loaded = python(
        """
import json, sys
from importlib import import_module
heavy = []
for name in sys.argv[1:]:
    import_module(name)
    if "torch" in sys.modules:
        heavy.append(name)
        break
print(json.dumps(heavy))
""",
        "fragprune_plugins",
        *light,
    )
    assert loaded == []


@pytest.mark.parametrize(
    ("code", "absent"),
    [
        (
            "from fragprune_plugins.plugins.loading import load_plugins as load\n"
            "assert [(a.name, a.info.title, [str(s) for s in a.seams]) for a in load().adapters]",
            "torch",
        ),
        (
            "from fragprune_plugins.engines.cpu import binding; "
            "assert binding.available() or not binding.usable_builds()",
            "torch",
        ),
        ("import fragprune_plugins.workbench.run.started", "torch"),  # by many scripts of a sweep
        (
            "import torch, fragprune_plugins as fp\n"
            "store = fp.ThresholdStore.from_falloff(torch.tensor([0.1, 0.2])).clone()\n"
            "store.keep(torch.tensor([True, False]))\n"
            "assert len(store) == 1",
            "torch._dynamo",  # which an optimizer asks for, and torch takes a second for it
        ),
    ],
    ids=["every plugin", "compiled code", "a script of no host", "drawing with cutoffs"],
)
def test_what_takes_long_to_import_is_left_out(python, code, absent):
    said = f"{code}\nimport json, sys\nprint(json.dumps('{absent}' in sys.modules))"
    assert python(said) is False


def test_import_rules_hold():
    program = shutil.which("lint-imports", path=str(Path(sys.executable).parent))
    if program is None:
        pytest.skip("import-linter is not installed")
    done = subprocess.run([program], cwd=ROOT, capture_output=True, text=True)
    assert done.returncode == 0, done.stdout


OF_ADAPTERS = {"fragprune_plugins.adapting", "fragprune_graphdeco"}
KNOWN = {
    "reference_renderer": set(),
    "fragprune_plugins": {"reference_renderer"},
    "fragprune_graphdeco": {"fragprune_plugins.adapting", "fragprune_plugins.learning.losses"},
    # what its forks do otherwise is theirs
    "fragprune_vanilla_3dgs": {
        *OF_ADAPTERS,
        *("fragprune_3dgs_fork", "fragprune_3dgs_fork.methods", "fragprune_3dgs_fork.read"),
    },
    **{
        name: {*OF_ADAPTERS, "fragprune_3dgs_fork.holding"}
        for name in (
            *("fragprune_2dgs", "fragprune_4dgaussians", "fragprune_light_gaussian"),
            *("fragprune_mcmc", "fragprune_mini_splatting", "fragprune_mip_splatting"),
            *("fragprune_rain_gs", "fragprune_speedy_splat"),
        )
    },
    # its host moves in time
    "fragprune_rt_4dgs": {
        *OF_ADAPTERS,
        "fragprune_plugins.slicing.cutting",
        "fragprune_plugins.slicing.splats",
    },
    # its host draws with gsplat; it activates a session itself, and ends it at Ctrl-C
    "fragprune_nerfstudio": {
        *("fragprune_gsplat", "fragprune_gsplat.dialect", "fragprune_plugins"),
        *("fragprune_plugins.adapting", "fragprune_plugins.errors", "fragprune_plugins.injection"),
        *("fragprune_plugins.injection.options", "fragprune_plugins.injection.process"),
        *("fragprune_plugins.injection.session", "fragprune_plugins.learning.events"),
        *("fragprune_plugins.learning.interruption", "fragprune_plugins.learning.stage2"),
        *("fragprune_plugins.learning.deferred", "fragprune_plugins.plugins.loading"),
    },
}


def test_of_ours_a_package_knows_only_what_it_is_built_on():
    """An adapter the module made for adapters and its family's, the core none, the oracle nobody.

    nerfstudio's adapter is more: a method of nerfstudio.
    """
    for package in PACKAGES:
        ours = {name for name in imported(package) if name.split(".")[0] in PACKAGES}
        others = {name for name in ours if name.split(".")[0] != package}
        assert others <= KNOWN.get(package, OF_ADAPTERS), package


@pytest.mark.parametrize(
    ("module", "names"),
    [(fragprune_plugins, fragprune_plugins.__all__), (adapting, adapting._LATE)],
    ids=["fragprune_plugins", "adapting"],
)
def test_public_names_resolve_and_no_others(module, names):
    assert not [name for name in names if getattr(module, name) is None]
    assert set(fragprune_plugins.__all__) <= set(dir(fragprune_plugins))
    with pytest.raises(AttributeError, match="no attribute 'prune'"):
        module.prune  # noqa: B018


def test_every_package_is_typed():
    folders = [Path(find_spec(package).origin).parent for package in PACKAGES]
    assert not [folder for folder in folders if not (folder / "py.typed").is_file()]


def test_modules_are_called_after_what_they_hold():
    vague = {"utils", "util", "helpers", "helper", "common_utils", "misc", "manager"}
    assert not [m for m in MODULES if vague & set(m.split("."))]
    assert not [p for p in (ROOT / "tests").rglob("*.py") if p.stem in vague]


def test_the_shelf_is_no_package_and_every_book_on_it_is_an_entry_point():
    """A host's adapter is a plugin, a viewer's an npm package and a bridge."""
    assert not (ROOT / "adapters" / "__init__.py").exists()
    viewers = {name for name in ADAPTERS if (ROOT / "adapters" / name / "package.json").exists()}
    assert viewers == {bridge.value for bridge in entry_points(group=bridge_command.GROUP)}
    loaded = load_plugins().loaded.values()
    assert set(ADAPTERS) - viewers <= {value.partition(":")[0] for value in loaded}
    project = (ROOT / "pyproject.toml").read_text()
    entries = re.findall(r'= "(fragprune_\w+)[:"]', project)
    assert [adapter for adapter in ADAPTERS if entries.count(adapter) != 1] == []


def test_versions_agree():
    assert version("fragprune-plugins") == fragprune_plugins.__version__


def test_a_package_says_first_what_it_is():
    for package in PACKAGES:
        first = (import_module(package).__doc__ or "").strip().splitlines()[0]
        assert first.endswith((".", ":", ",")), package
        if package in ADAPTERS:
            assert "/" in first.split()[0]  # owner/name of the host's repository
