"""docs/how-to/several-gpus.md: what it shows runs."""

import re
import runpy
import sys
from pathlib import Path

import torch
from finetune import tiny
from finetune.several import launch

import fragprune_plugins as fp
from fragprune_plugins.files.ply import read_ply

HOW_TO = Path(__file__).parents[2] / "docs" / "how-to"


def test_the_lines_in_python_run_in_each_process(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    data, path, model = tiny.scene(tmp_path)
    path.rename("city.ply")
    text = (HOW_TO / "several-gpus.md").read_text()
    block = re.search(r"\n((?:    .*\n|\n)*    with fp\.joined.*\n(?:(?:    .*)?\n)+)", text)
    lines = "\n".join(line[4:] for line in block[1].splitlines())
    given = {
        "fp": fp,
        "device": torch.device("cpu"),
        "scene": fp.load_dataset(data),
        "settings": fp.Settings(3, views_per_step=2),
        "view": tiny.cameras()[0].view(),
    }

    def work(_):
        exec(lines, given)  # they join by themselves
        return given["outputs"].image.detach()

    first, second = launch(2, work)
    assert (first.code, second.code) == (0, 0)
    with torch.no_grad():
        alone = fp.rasterize(fp.RasterInputs(given["view"], model.splats())).image
    assert torch.equal(first.left, alone)
    assert torch.equal(second.left, alone)
    assert len(read_ply(tmp_path / "pruned.ply")) == len(model)


def test_the_script_that_measures_memory_runs(monkeypatch, capfd):
    script = HOW_TO / "several_gpus_memory.py"
    monkeypatch.setattr(sys, "argv", [str(script), "400", "opacity"])
    runpy.run_path(str(script))
    assert "opacity, processes: 1, MB of each: [" in capfd.readouterr().out
