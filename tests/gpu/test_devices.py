"""Whole commands on a pretended GPU: no call mixes devices, and the results are the CPU's."""

import json
import os
import shutil
import subprocess
import sys
from pathlib import Path

import pytest
import torch
from cli.commands import drawing, run_json
from finetune import tiny

from fragprune_plugins.files import sidecar
from fragprune_plugins.files.ply import read_ply
from fragprune_plugins.testing.host import MINIATURE
from fragprune_plugins.workbench.models.formats.ply import write_ply

pytestmark = pytest.mark.skipif(
    shutil.which("g++") is None or torch.version.cuda or not hasattr(torch, "accelerator"),
    reason="needs g++, and a torch of 2.6 or later without CUDA",
)


@pytest.fixture
def python(device):
    """Runs a program that has imported the pretended GPU; its words follow."""

    def run(text: str, *words: object, where: Path) -> str:
        inside = f"from gpu import pretended\nwith pretended.leaving(): exec({text!r})"
        program = ["-c", inside, str(device.folder)]
        command = [sys.executable, *program, *map(str, words)]
        paths = {"PYTHONPATH": os.pathsep.join(sys.path)}
        done = subprocess.run(
            command, cwd=where, env=os.environ | paths, capture_output=True, text=True
        )
        assert done.returncode == 0, done.stderr[-3000:]
        return done.stdout

    return run


MIXES = """
import torch

def expect_refused(call):
    try:
        call()
    except RuntimeError as error:
        assert "is on the CPU" in str(error) or "on the GPU changes" in str(error), error
    else:
        raise SystemExit("nothing was refused")

class Careless(torch.autograd.Function):
    forward = staticmethod(lambda ctx, x: x.clone())
    backward = staticmethod(lambda ctx, grad: grad * torch.ones(3))

with pretended.a_gpu():
    there, here = torch.ones(3, device="cuda", requires_grad=True), torch.ones(3)
    for call in (
        lambda: there + here,
        lambda: here[there > 0],
        lambda: torch.cat([there, here]),
        lambda: here.add_(there.detach()),
        lambda: Careless.apply(there).sum().backward(),
    ):
        expect_refused(call)
    there.square().sum().backward()
    assert there.grad.is_cuda and there.cpu().tolist() == [1, 1, 1]
"""


def test_what_mixes_devices_is_refused_as_on_a_gpu(python, tmp_path):
    python(MIXES, where=tmp_path)


@pytest.fixture
def scene(tmp_path):
    """A scene of COLMAP's, with points to begin from, and a model beside it."""
    truth = tiny.random_model()
    scene = tiny.write_colmap(tmp_path / "scene", tiny.photographs(truth))
    points = [f"{i} {x} {y} {z} 99 99 99 1" for i, (x, y, z) in enumerate(truth.xyz.tolist(), 1)]
    (scene / "sparse" / "0" / "points3D.txt").write_text("\n".join(points) + "\n")
    write_ply(tmp_path / "model.ply", tiny.perturbed(truth))
    return scene


def test_a_model_learns_there_as_on_the_cpu(python, scene, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    words = ["model.ply", "--data", scene, "--iters", 10, "--dropout", 0.2, "--json"]
    text = "pretended.main()"
    here = run_json("finetune", *words, "--device", "cpu", "--out", "cpu.ply")["after"]
    there = python(text, "finetune", *words, "--device", "cuda", "--out", "a.ply", where=tmp_path)
    found = json.loads(there)["after"]
    assert (found["engine"], here["engine"]) == ("cuda", "cpu")
    for figure in ("psnr", "fragments_per_pixel", "ssim"):
        assert found[figure] == pytest.approx(here[figure], rel=1e-3)


COMMANDS = """
import json
import sys
from unittest import mock
from cli.commands import run_json
from fragprune_plugins.engines.cuda.engine import CudaEngine

draw, frames = CudaEngine.rasterize, []

def drawn(engine, inputs, thresholds):
    given = vars(inputs.view) | vars(inputs.splats) | {"thresholds": thresholds}
    frames.append([name for name, each in given.items() if not getattr(each, "is_cuda", True)])
    return draw(engine, inputs, thresholds)

with pretended.a_gpu(), mock.patch.object(CudaEngine, "rasterize", drawn):
    for words in json.loads(sys.argv[2]):
        frames.clear()
        report = run_json(*words)
        row = report["results"][0] if "results" in report else report
        row = row if "device" in row else row.get("columns", {}).get("truncated", row)
        told = words[0] in ("finetune", "render", "profile", "bench")
        assert frames and not any(frames), frames  # nothing lay elsewhere
        assert not told or row["engine"] == row["device"][:4] == "cuda", report
"""


def test_every_command_draws_there(python, scene, tmp_path):
    path, out = tmp_path / "cut.ply", tmp_path / "out"
    write_ply(path, tiny.cut(read_ply(tmp_path / "model.ply"), 0.3))
    cameras = tiny.write_path(tmp_path / "path.json", ["a", "b"])
    words = [[name, *given] for name, given in drawing(scene, path, cameras, out).items()]
    words += [
        ["render", path, "--cameras", cameras, "--out", out],
        ["report", out, "--data", scene],
    ]
    words += [["bench", "--size", "24x16", "--gaussians", 40]]
    python(COMMANDS, json.dumps(words, default=str), where=tmp_path)


def test_a_host_trains_and_is_pruned_there(python, scene, tmp_path):
    host, out = shutil.copytree(MINIATURE, tmp_path / "host"), tmp_path / "out"
    ours = ["--device", "cuda", "--iters", 20, "--json", "--", host / "train.py"]
    theirs = ["-s", scene, "-m", out, "--iterations", 20, "--eval"]
    result = json.loads(python("pretended.main()", "run", *ours, *theirs, where=tmp_path))
    assert (result["engine"], result["device"]) == ("cuda", "cuda")
    (model,) = out.glob("point_cloud/*/*.safetensors")
    learned = sidecar.load(model.with_name("point_cloud.ply"))[0]
    assert (learned.steps, learned.neutral, len(learned)) == (20, False, result["gaussians"])
