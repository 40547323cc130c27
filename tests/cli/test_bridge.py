"""fragprune bridge: JavaScript modules for web viewers."""

import json
import sys
from importlib.metadata import EntryPoint
from pathlib import Path
from types import ModuleType

import pytest
from cli.commands import fails, run, run_json

from fragprune_plugins import __version__
from fragprune_plugins.workbench import bridge

VIEWERS = ["playcanvas", "spark"]


def test_without_a_name_it_lists_the_bridges():
    bridges = run_json("bridge")["bridges"]
    assert list(bridges) == VIEWERS
    assert all(Path(module).is_file() for module in bridges.values())


@pytest.mark.parametrize("viewer", VIEWERS)
def test_the_folder_is_an_npm_package_of_one_module(viewer):
    folder = Path(run("bridge", viewer).stdout.strip())
    package = json.loads((folder / "package.json").read_text())
    assert package["version"] == __version__
    assert package["files"] == [module.name for module in folder.glob("*.mjs")]
    assert package["exports"] == f"./{package['files'][0]}"
    assert package["peerDependencies"]


@pytest.mark.parametrize("viewer", VIEWERS)
def test_the_module_is_copied_into_a_new_folder(viewer, tmp_path):
    wrote = Path(run_json("bridge", viewer, "--out", tmp_path / "website")["module"])
    assert wrote.parent == tmp_path / "website"
    assert "export async function installCutoffs" in wrote.read_text()
    said = run("bridge", viewer, "--out", tmp_path).stdout
    assert "first lines show how a page calls installCutoffs" in said
    assert "await installCutoffs(" in wrote.read_text().partition("*/")[0]


def test_a_folder_that_cannot_be_made_is_a_stated_error(tmp_path):
    (tmp_path / "taken").write_text("")
    asked = ("bridge", "spark", "--out", tmp_path / "taken" / "website")
    fails(*asked, says=str(tmp_path / "taken"), code=1)


@pytest.mark.parametrize("module", ["no.such.package", "json", "sys:exit", "bridge_of_3"])
def test_a_broken_bridge_is_named(monkeypatch, module):
    numbered = ModuleType("bridge_of_3")
    numbered.MODULE = 3
    monkeypatch.setitem(sys.modules, "bridge_of_3", numbered)
    broken = EntryPoint("mine", module, bridge.GROUP)
    monkeypatch.setattr(bridge, "offered", lambda group: {"mine": broken})
    for words in ((), ("mine",)):
        fails("bridge", *words, says="[plugin] fragprune.bridges mine", code=1)
