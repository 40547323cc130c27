"""What setup.py compiles for a platform, and what a wheel and a package index get.

The compiler is a stand-in that writes its arguments where the library goes. `.ci/wheels` builds,
installs and runs real ones.
"""

import os
import re
import runpy
import shutil
import subprocess
import sys
import zipfile
from pathlib import Path

import pytest

from fragprune_plugins.engines.cpu import binding

ROOT = Path(__file__).parents[2]
COMPILER = """#!/bin/sh
all="$*"
while [ "$1" != -o ]; do shift; done
echo "$all" > "$2"
"""


@pytest.fixture(scope="module")
def project(tmp_path_factory):
    """setup.py with the engine's sources, and a compiler beside it."""
    folder = tmp_path_factory.mktemp("project")
    for name in ("setup.py", "pyproject.toml", "README.md", "LICENSE"):
        shutil.copy(ROOT / name, folder)
    native = Path("fragprune_plugins", "native")
    leave = shutil.ignore_patterns("*.so", "*.pyd", "__pycache__")
    shutil.copytree(ROOT / native, folder / native, ignore=leave)
    (folder / "fragprune_plugins" / "__init__.py").touch()
    (folder / "adapters").mkdir()
    compiler = folder / "compiler"
    compiler.write_text(COMPILER)
    compiler.chmod(0o755)
    return folder


def wheel(project: Path, **variables: str) -> tuple[str, dict[str, str]]:
    """A wheel's name, and its libraries with the arguments they were compiled with."""
    for made in ("build", "dist"):
        shutil.rmtree(project / made, ignore_errors=True)
    kept = {key: value for key, value in os.environ.items() if not key.endswith("FLAGS")}
    done = subprocess.run(
        [sys.executable, "setup.py", "-q", "bdist_wheel"],
        cwd=project,
        env=kept | {"CXX": str(project / "compiler")} | variables,
        capture_output=True,
        text=True,
        timeout=120,
    )
    assert done.returncode == 0, done.stderr[-4000:]
    (made,) = (project / "dist").iterdir()
    with zipfile.ZipFile(made) as content:
        names = [name for name in content.namelist() if name.endswith((".so", ".pyd"))]
        return made.name, {Path(name).name: content.read(name).decode() for name in names}


@pytest.mark.parametrize(
    ("platform", "tag", "builds"),
    [
        ("linux-x86_64", "linux_x86_64", set(binding.BUILDS)),
        ("linux-aarch64", "linux_aarch64", {"baseline"}),
        ("macosx-11.0-arm64", "macosx_11_0_arm64", {"baseline"}),
    ],
)
def test_a_wheel_fits_every_python_and_holds_what_its_platform_runs(project, platform, tag, builds):
    name, libraries = wheel(project, _PYTHON_HOST_PLATFORM=platform)
    assert name.endswith(f"-py3-none-{tag}.whl")
    assert set(libraries) == {f"_cpu_{build}{binding._SUFFIX}" for build in builds}
    for library, arguments in libraries.items():
        assert ("-mavx2" in arguments) == ("avx2" in library)


def test_a_packager_adds_flags_and_this_python_adds_none(project):
    _, libraries = wheel(project, CXXFLAGS="-g1 -DNDEBUG", LDFLAGS="-Wl,-z,now")
    said = libraries["_cpu_baseline.so"].split()
    assert [word for word in said if word in ("-g1", "-DNDEBUG", "-Wl,-z,now")] == [
        *("-g1", "-DNDEBUG", "-Wl,-z,now")
    ]
    assert not [word for word in said if word.startswith(("-I", "-L", "-l"))]


def test_a_change_to_any_header_that_the_engine_includes_rebuilds_it(monkeypatch):
    monkeypatch.chdir(ROOT)  # where its paths begin
    shipped = runpy.run_path("setup.py")
    text = "".join(path.read_text() for path in (shipped["SOURCE"], *shipped["HEADERS"]))
    included = set(re.findall(r'^#include "(?:.*/)?(\w+\.h)"', text, re.MULTILINE))
    assert included == {path.name for path in shipped["HEADERS"]}


@pytest.mark.parametrize("compiler", ["false", "no-such-compiler"])
def test_without_a_compiler_there_is_a_wheel_all_the_same(project, compiler):
    assert wheel(project, CXX=compiler)[1] == {}


def test_a_package_index_is_shown_no_link_that_leads_nowhere(monkeypatch):
    monkeypatch.chdir(ROOT)
    shown = runpy.run_path("setup.py")["description"]()
    targets = re.findall(r"\]\(([^)]*)\)", shown)
    assert not [target for target in targets if not target.startswith(("https:", "http:"))]
    assert "fragprune run -- python train.py" in shown
