"""Hosts with worker processes, a compiled render function, or several ranks."""

import json
import sys
from pathlib import Path

import pytest
import torch
from finetune import several
from miniatures.runs import OPTIONS, command, edit, written
from miniatures.vanilla_3dgs import joint

from fragprune_plugins.errors import RanksError
from fragprune_plugins.files import sidecar
from fragprune_plugins.injection import ranks
from fragprune_plugins.injection.launch import RunOptions, run
from fragprune_plugins.testing import Host
from fragprune_plugins.testing.fresh import fresh

WORKERS = """
import json
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import torch
from gaussian_renderer import render
from scene.gaussian_model import GaussianModel


class Views(torch.utils.data.Dataset):
    def __init__(self, cameras, pipe, model=None):
        self.cameras, self.pipe, self.model = cameras, pipe, model

    def __len__(self):
        return len(self.cameras)

    def __getitem__(self, index):
        camera, model = self.cameras[index], self.model
        if model is None:
            model = GaussianModel(1)
            points = np.random.default_rng(0).uniform(-1, 1, (20, 3))
            model.create_from_pcd(SimpleNamespace(points=points, colors=points * 0), 1.0)
        try:
            with torch.no_grad():
                drawn = render(camera, model, self.pipe, torch.zeros(3, device="cuda"))["render"]
        except Exception as error:
            drawn = str(error)
        return camera.image_name, camera.original_image.cuda(), drawn


def look(kind, cameras, pipe, model, out):
    here = Views(cameras[:2], pipe, model)
    there = Views(cameras[:2], pipe, model if kind == "fork" else None)
    loader = torch.utils.data.DataLoader(
        there, batch_size=None, num_workers=1, multiprocessing_context=kind
    )
    pairs = zip(here, loader)
    found = [[a[0] == b[0], torch.equal(a[1], b[1]), same(a[2], b[2])] for a, b in pairs]
    Path(out, "seen").write_text(json.dumps(found))


def same(here, there):
    return there if isinstance(there, str) else torch.equal(here, there)
"""

JOINT = RunOptions(stage="joint", from_iter=4, device="cpu", settings=OPTIONS.settings)


def trained(root: Path, scene: Path, options: RunOptions) -> tuple[bytes, list[float], list[str]]:
    """Train 12 iterations: the model, its thresholds, and what Python could only print."""
    unraisable: list[str] = []
    sys.unraisablehook = lambda raised: unraisable.append(repr(raised.exc_value))
    run(command(root / "host" / "train.py", scene, root / "out", 12), options)
    model = root / "out/point_cloud/iteration_12/point_cloud.ply"
    return model.read_bytes(), sidecar.load(model)[0].logits.tolist(), unraisable


@pytest.mark.parametrize("kind", ["fork", "spawn"])
def test_workers_load_views_and_draw_with_thresholds_or_are_refused(kind, photographs, tmp_path):
    """A forked worker knows the thresholds of its moment; a spawned one has none."""
    root = written(Host, tmp_path / "host")
    (root / "watching.py").write_text(WORKERS)
    look = f"    from watching import look\n    look('{kind}', scene.getTrainCameras(), pipe, "
    edit(root / "train.py", "    bar.close()\n", look + "gaussians, dataset.model_path)\n")
    fresh(trained, tmp_path, photographs, JOINT)
    for name, photograph, picture in json.loads((tmp_path / "out/seen").read_text()):
        assert (name, photograph) == (True, True)
        if kind == "fork":
            assert picture is True
        else:
            assert "a spawned worker process that draws" in picture
            assert "Start workers by fork" in picture


@pytest.mark.skipif(
    torch.__version__ < "2.5", reason="torch compiles nothing here, or nothing beside substitutes"
)
def test_a_compiled_render_function_learns_the_same_bits(photographs, tmp_path):
    results = []
    for name in ("plain", "compiled"):
        root = written(Host, tmp_path / name / "host")
        if name == "compiled":
            line = "    gaussians.training_setup(opt)\n"
            compiled = "    global render\n    render = torch.compile(render, backend='eager')\n"
            edit(root / "train.py", line, line + compiled)
        results.append(fresh(trained, tmp_path / name, photographs, JOINT))
    assert results[0] == results[1]
    assert results[1][2] == []


def test_under_torchrun_run_says_once_why_it_learns_in_one_process(photographs, tmp_path):
    script = written(Host, tmp_path / "host") / "train.py"
    words = command(script, photographs, tmp_path / "out", 12)
    ended = several.command(2, "run", "--device", "cpu", "--", *words)
    left = [each.left for each in ended]
    assert [code for code, _, _ in left] == [1, 1]
    said = "".join(out + err for _, out, err in left)
    assert said.count("[ranks]") == 1
    assert "WORLD_SIZE=2 in the environment" in said
    assert "torchrun -m fragprune_plugins finetune" in said
    assert not (tmp_path / "out").exists()


@pytest.mark.parametrize(
    "launcher",
    ["torchrun --nproc_per_node 2", "/opt/bin/torchrun", "python -m torch.distributed.run",
     "python3.11 -m torch.distributed.launch", "accelerate launch"],
)  # fmt: skip
def test_a_command_that_starts_several_processes_is_refused(launcher):
    with pytest.raises(RanksError, match=r"starts several processes; .* Leave the launcher"):
        run([*launcher.split(), "train.py", "-s", "scene"], RunOptions(device="cpu"))


def test_a_host_that_makes_ranks_itself_is_refused_when_it_begins_to_train(monkeypatch):
    with joint() as host:
        monkeypatch.setattr(torch.distributed, "is_initialized", lambda: True)
        monkeypatch.setattr(torch.distributed, "get_world_size", lambda: 2)
        with pytest.raises(RanksError, match=r"torch\.distributed with 2 processes"):
            host.model()


@pytest.mark.parametrize("said", ["1", "", "many"])
def test_one_rank_is_no_reason_to_refuse(said, monkeypatch):
    monkeypatch.setenv("WORLD_SIZE", said)
    ranks.expect_one()
