"""An installed package adds to every edge; a folder that is deleted takes only itself away."""

import json
import os
import shutil
import subprocess
import sys
from importlib import import_module
from pathlib import Path

import pytest
from click.testing import CliRunner
from finetune import tiny

from fragprune_plugins.files.ply import write_ply
from fragprune_plugins.testing.fresh import fresh

if sys.version_info >= (3, 11):
    import tomllib
else:
    import tomli as tomllib

ROOT = Path(__file__).parents[2]

MODULE = '''
import click
import torch

from fragprune_plugins.engines import create_engine
from fragprune_plugins.plugins.hookspecs import hookimpl
from fragprune_plugins.workbench.commands.command import Command, Report
from fragprune_plugins.workbench.models import formats


@click.command("count", cls=Command)
@click.argument("model")
def count(model):
    """Count the Gaussians of MODEL."""
    from fragprune_plugins import load

    return Report({"gaussians": len(load(model))}, "")


class Mine:
    name = "mine"

    def rasterize(self, inputs, thresholds):
        outputs = create_engine("reference").rasterize(inputs, thresholds)
        outputs.image.fill_(0.5)
        return outputs


@hookimpl
def fragprune_create_engine(name, device):
    return Mine() if name == "mine" else None


class Lines:
    def __init__(self, place):
        self.file = open(place, "w")

    def write(self, stats):
        print(stats.step, file=self.file)

    def close(self):
        self.file.close()


def read(reading):
    return torch.load(reading.file, weights_only=False)


def write(file, model):
    torch.save(model, file)


FORMAT = formats.Format("mine", ".mine", read, write, thresholds="as they are")
'''

POINTS = """
[fragprune]
mine = mine
[fragprune.commands]
count = mine:count
[fragprune.formats]
mine = mine:FORMAT
[fragprune.logs]
lines = mine:Lines
"""


def install(folder: Path, name: str, points: str) -> None:
    """What pip leaves of a distribution, in a folder of sys.path."""
    info = folder / f"{name}-1.0.dist-info"
    info.mkdir(parents=True)
    (info / "METADATA").write_text(f"Metadata-Version: 2.1\nName: {name}\nVersion: 1.0\n")
    (info / "entry_points.txt").write_text(points)


def fragprune(*words: object, path: list[Path], cwd: Path) -> str:
    """What a fresh ``fragprune`` prints that finds packages in these folders first."""
    found = os.pathsep.join(map(str, path))
    done = subprocess.run(
        [sys.executable, "-m", "fragprune_plugins", *map(str, words)],
        capture_output=True,
        text=True,
        cwd=cwd,
        env={**os.environ, "PYTHONPATH": found},
        timeout=240,
    )
    assert done.returncode == 0, done.stdout + done.stderr
    return done.stdout


@pytest.fixture
def model(tmp_path: Path) -> Path:
    path = tmp_path / "model.ply"
    write_ply(path, tiny.random_model())
    cameras = tiny.transforms(["a"], tiny.cameras()[:1]) | {"w": 20, "h": 12}
    (tmp_path / "cameras.json").write_text(json.dumps(cameras))
    return path


def invoked(site: str, folder: str, words: list[str]) -> str:
    """What the command prints where a folder of packages comes first."""
    sys.path.insert(0, site)
    os.chdir(folder)
    result = CliRunner().invoke(import_module("fragprune_plugins.workbench.commands").cli, words)
    assert result.exit_code == 0, result.output
    return result.stdout


def test_one_package_adds_a_command_a_format_an_engine_and_a_log(tmp_path, model):
    site = tmp_path / "site"
    install(site, "mine", POINTS)
    (site / "mine.py").write_text(MODULE)

    def call(line: str) -> str:
        return fresh(invoked, str(site), str(tmp_path), line.split())

    assert "Count the Gaussians" in call("--help")
    call("export model.ply --out model.mine")
    assert json.loads(call("count model.mine --json")) == {"gaussians": 60}
    drawn = call("render model.mine --engine mine --cameras cameras.json --out grey --json")
    assert json.loads(drawn)["engine"] == "mine"
    short = "--iters 3 --resolution 16 --train opacity --log lines:steps.txt"
    call(f"finetune model.mine --self --out p.mine {short}")
    assert (tmp_path / "steps.txt").read_text().split() == ["1", "2", "3"]


def test_an_adapter_and_a_slice_go_with_their_folders(tmp_path, model):
    """On a copy of the tree: nothing else needs them."""
    copy = tmp_path / "copy"
    spare = shutil.ignore_patterns("__pycache__", "*.so")
    for name in ("fragprune_plugins", "reference_renderer", "adapters"):
        shutil.copytree(ROOT / name, copy / name, ignore=spare)
    shutil.copy(ROOT / "pyproject.toml", copy)
    shutil.rmtree(copy / "adapters" / "fragprune_mcmc")
    shutil.rmtree(copy / "fragprune_plugins" / "workbench" / "audit")
    points = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]["entry-points"]
    del points["fragprune"]["mcmc"]
    del points["fragprune.commands"]["audit"]
    lines = []
    for group, values in points.items():
        lines += [f"[{group}]", *(f"{name} = {value}" for name, value in values.items())]
    install(copy, "fragprune_plugins", "\n".join(lines))
    path = [copy, copy / "adapters"]
    help = fragprune("--help", path=path, cwd=copy)
    assert "  compare " in help
    assert "  audit " not in help
    adapters = json.loads(fragprune("adapters", "--json", path=path, cwd=copy))
    assert adapters["findings"] == []
    assert "mcmc" not in [each["name"] for each in adapters["adapters"]]
    words = ("--cameras", tmp_path / "cameras.json", "--engine", "reference", "--out", "pictures")
    fragprune("render", model, *words, path=path, cwd=copy)
    linted = subprocess.run(
        [str(Path(sys.executable).with_name("lint-imports"))],
        capture_output=True,
        text=True,
        cwd=copy,
        env={**os.environ, "PYTHONPATH": str(copy)},
        timeout=240,
    )
    assert linted.returncode == 0, linted.stdout
