"""An installed package adds to every edge; a folder that is deleted takes only itself away."""

import json
import os
import shutil
import sys
from pathlib import Path

import pytest
from finetune import tiny

from fragprune_plugins.workbench.models.formats.ply import write_ply

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
view = mine:count
[fragprune.formats]
mine = mine:FORMAT
else = another:FORMAT
spz = mine:FORMAT
[fragprune.logs]
lines = mine:Lines
"""


def install(folder: Path, name: str, points: str) -> None:
    """What pip leaves of a distribution, in a folder of sys.path."""
    info = folder / f"{name}-1.0.dist-info"
    info.mkdir(parents=True)
    (info / "METADATA").write_text(f"Metadata-Version: 2.1\nName: {name}\nVersion: 1.0\n")
    (info / "entry_points.txt").write_text(points)


COMMANDS = """
import json, sys
from click.testing import CliRunner
from fragprune_plugins.workbench.commands import cli
results = [CliRunner().invoke(cli, line.split()) for line in sys.argv[1:]]
print(json.dumps([(result.exit_code, result.stdout, result.stderr) for result in results]))
"""


@pytest.fixture
def model(tmp_path: Path) -> Path:
    path = tmp_path / "model.ply"
    write_ply(path, tiny.random_model())
    tiny.write_path(tmp_path / "cameras.json", ["a"])
    return path


@pytest.mark.usefixtures("model")
def test_one_package_adds_a_command_formats_an_engine_and_a_log_and_takes_no_name(tmp_path, python):
    site = tmp_path / "site"
    install(site, "mine", POINTS)
    (site / "mine.py").write_text(MODULE)
    reads = "return torch.load(reading.file, weights_only=False)"
    other = MODULE.replace(reads, "return ()").replace('".mine"', '".else"')
    (site / "another.py").write_text(other)
    (tmp_path / "a.else").write_bytes(b"")
    lines = (
        "--help",
        "export model.ply --out model.mine",
        "count model.mine --json",
        "render model.mine --engine mine --cameras cameras.json --out grey --json",
        "finetune model.mine --self --out p.mine --iters 3 --resolution 16 --train opacity "
        "--log lines:steps.txt",
        "view --help",
        "export model.ply --out model.spz",
        "export a.else --out a.ply",
    )
    codes, said, told = zip(*python(COMMANDS, *lines, path=site), strict=True)
    assert codes == (0, 0, 0, 0, 0, 0, 0, 1), told
    assert "Count the Gaussians" in said[0]
    assert json.loads(said[2]) == {"gaussians": 60}
    assert json.loads(said[3])["engine"] == "mine"
    assert (tmp_path / "steps.txt").read_text().split() == ["1", "2", "3"]
    assert "Count the Gaussians" not in said[5]
    assert "fragprune.commands view of mine is left out" in "".join(told)
    assert (tmp_path / "model.spz").read_bytes()[:4] != b"PK\3\4"  # as torch writes it
    assert "[plugin] format mine: tuple from a.else; expected a Model" in told[7]


@pytest.mark.usefixtures("model")
def test_an_adapter_and_a_slice_go_with_their_folders(tmp_path, python):
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
    render = "render model.ply --cameras cameras.json --engine reference --out pictures"
    path = os.pathsep.join([str(copy), str(copy / "adapters")])
    answers = python(COMMANDS, "--help", "adapters --json", render, path=path)
    codes, (help, adapters, _), told = zip(*answers, strict=True)
    assert not any(codes), told
    assert "  compare " in help
    assert "  audit " not in help
    adapters = json.loads(adapters)
    assert adapters["findings"] == []
    assert "mcmc" not in [each["name"] for each in adapters["adapters"]]
