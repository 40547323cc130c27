"""docs/how-to/write-an-adapter.md, followed to the letter: its files written, its commands run.

Only ``pip install`` is done by hand: it would change the environment of every other test.
"""

from __future__ import annotations

import os
import re
import shlex
import subprocess
import sys
from pathlib import Path

import pytest

from fragprune_plugins.demo.scene import SceneSettings, make_scene

PAGE = Path(__file__).parents[2] / "docs" / "how-to" / "write-an-adapter.md"
BLOCKS = re.findall(r"^```(\w+)\n(.*?)^```$", PAGE.read_text(), re.MULTILINE | re.DOTALL)
FILES = {
    text.splitlines()[0].removeprefix("# "): text for kind, text in BLOCKS if kind != "console"
}
COMMANDS = [
    (block.splitlines()[0], block.splitlines()[1:])
    for kind, text in BLOCKS
    if kind == "console"
    for block in text.split("$ ")[1:]
]
INSTALL = "pip install -e ."


def install(folder: Path) -> None:
    """What pip would do with the page's pyproject.toml: metadata beside the module."""
    project = FILES["pyproject.toml"]
    (entry,) = re.findall(r"^\[project\.entry-points\.fragprune\]\n(.*)", project, re.MULTILINE)
    name, version = (
        re.search(rf'^{key} = "(.*)"', project, re.M)[1] for key in ("name", "version")
    )
    info = folder / f"{name.replace('-', '_')}-{version}.dist-info"
    info.mkdir()
    (info / "METADATA").write_text(f"Metadata-Version: 2.1\nName: {name}\nVersion: {version}\n")
    (info / "entry_points.txt").write_text(f"[fragprune]\n{entry.replace(chr(34), '')}\n")


def test_the_page_has_every_file_and_command():
    assert list(FILES) == [
        "pyproject.toml",
        "fragprune_soft_3dgs.py",
        "soft_3dgs_host.py",
        "conftest.py",
        "test_soft_3dgs.py",
    ]
    words = [command.split(" ")[:2] for command, _ in COMMANDS]
    check = ["fragprune", "check"]
    assert words == [
        check,
        check,
        ["pip", "install"],
        check,
        ["pytest", "test_soft_3dgs.py"],
        ["fragprune", "run"],
    ]
    assert all(expected for command, expected in COMMANDS if command != INSTALL)


@pytest.fixture(scope="module")
def workplace(tmp_path_factory):
    """Where the reader sits: their checkout and their data beside nothing else."""
    folder = tmp_path_factory.mktemp("reader")
    for name, text in FILES.items():
        (folder / name).write_text(text)
    make_scene(
        folder / "scene", SceneSettings(views=9, width=40, height=30, supersample=1, points=150)
    )
    run(
        folder,
        f"{sys.executable} -c 'from soft_3dgs_host import SoftHost; from pathlib import Path;"
        ' SoftHost().write(Path("soft-3dgs"))\'',
    )
    return folder


def run(folder: Path, command: str) -> str:
    """A command of the page; what it prints, both streams."""
    environment = os.environ | {
        "PYTHONPATH": os.pathsep.join([str(folder), *filter(None, sys.path)]),
        "PATH": os.pathsep.join([str(Path(sys.executable).parent), os.environ["PATH"]]),
        "OMP_WAIT_POLICY": "PASSIVE",
    }
    environment.pop("FRAGPRUNE_HOSTS", None)
    done = subprocess.run(
        shlex.split(command),
        cwd=folder,
        env=environment,
        capture_output=True,
        text=True,
        timeout=280,
        check=False,
    )
    return done.stdout + done.stderr


@pytest.mark.timeout(900)  # a suite of its own inside: half a minute, more on a busy machine
def test_following_the_page(workplace):
    for command, expected in COMMANDS:
        if command == INSTALL:
            install(workplace)
            continue
        said = " ".join(run(workplace, command).split())
        at = 0
        for line in expected:
            wanted = " ".join(line.split())
            at = said.find(wanted, at)
            assert at >= 0, f"$ {command}\nexpected {wanted!r} in:\n{said}"
