"""docs/how-to/write-an-adapter.md, followed to the letter: its files written, its commands run.

Of ``pip install`` only the package's metadata is made, by setuptools: more would change the
environment of every other test.
"""

import os
import re
import shlex
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

from fragprune_plugins.workbench.demo.scene import make_scene

PAGE = Path(__file__).parents[2] / "docs" / "how-to" / "write-an-adapter.md"
BLOCKS = re.findall(r"^```(\w+)\n(.*?)^```$", PAGE.read_text(), re.MULTILINE | re.DOTALL)
INSTALL = "pip install -e ."


def files() -> list[tuple[str, str]]:
    """Names and texts in the order of the page, which may write a file twice."""
    texts = [text for kind, text in BLOCKS if kind != "console"]
    return [(text.splitlines()[0].removeprefix("# "), text) for text in texts]


def commands(text: str) -> list[tuple[str, list[str]]]:
    """The commands of a block, each with the lines that it prints."""
    lines = [block.splitlines() for block in text.split("$ ")[1:]]
    return [(first, expected) for first, *expected in lines]


def install(folder: Path) -> None:
    """What pip asks of the page's pyproject.toml: metadata, which then lies beside the modules."""
    for earlier in folder.glob("*.dist-info"):
        shutil.rmtree(earlier)
    made = "prepare_metadata_for_build_editable"
    build = f"from setuptools.build_meta import {made}; {made}('.')"
    printed = run(folder, shlex.join([sys.executable, "-c", build]))
    assert any(folder.glob("*.dist-info")), printed


def test_the_page_has_every_file_and_command():
    names = {name for name, _ in files()}
    assert {"fragprune_soft_3dgs.py", "fragprune_blurred_3dgs.py", "conftest.py"} <= names
    assert (len(files()), len(names)) == (9, 8)  # one is written twice
    said = [each for kind, text in BLOCKS if kind == "console" for each in commands(text)]
    kinds = [" ".join(command.split()[:2]) for command, _ in said]
    assert [kinds.count(each) for each in ("fragprune check", "fragprune run")] == [4, 1]
    assert all(expected for command, expected in said if command != INSTALL)


@pytest.fixture(scope="module")
def workplace(tmp_path_factory):
    """Where the reader sits: their checkouts and their data beside nothing else."""
    folder = tmp_path_factory.mktemp("reader")
    make_scene(folder / "scene", views=9, width=40, points=150)
    hosts = [(name, text) for name, text in files() if name.endswith("_host.py")]
    for name, text in hosts:
        (folder / name).write_text(text)
    for name, kind in (("soft", "Soft"), ("blurred", "Blurred")):
        written = f"{kind}Host().write(Path('{name}-3dgs'))"
        code = f"from pathlib import Path; from {name}_3dgs_host import {kind}Host; {written}"
        run(folder, shlex.join([sys.executable, "-c", code]))
    for name, _ in hosts:
        (folder / name).unlink()
    return folder


def run(folder: Path, command: str) -> str:
    """A command of the page; what it prints, both streams."""
    environment = os.environ | {
        "PYTHONPATH": os.pathsep.join([str(folder), *filter(None, sys.path)]),
        "PATH": os.pathsep.join([str(Path(sys.executable).parent), os.environ["PATH"]]),
        "OMP_WAIT_POLICY": "PASSIVE",
    }
    environment.pop("FRAGPRUNE_HOSTS", None)
    how = {"shell": True, "cwd": folder, "env": environment, "timeout": 280}
    done = subprocess.run(command, capture_output=True, text=True, **how)
    return done.stdout + done.stderr


@pytest.mark.slow  # .ci/run runs it with the site
@pytest.mark.timeout(900)  # a suite of its own inside: half a minute, more on a busy machine
def test_following_the_page(workplace):
    page = iter(files())
    for kind, text in BLOCKS:
        if kind != "console":
            name, content = next(page)
            (workplace / name).write_text(content)
            continue
        for command, expected in commands(text):
            if command == INSTALL:
                install(workplace)
            else:
                expect(command, expected, run(workplace, command))


def expect(command: str, expected: list[str], printed: str) -> None:
    """The lines, in this order; what is between them and how wide gaps are does not matter."""
    said, at = " ".join(printed.split()), 0
    for line in expected:
        wanted = " ".join(line.split())
        at = said.find(wanted, at)
        assert at >= 0, f"$ {command}\nexpected {wanted!r} in:\n{said}"
