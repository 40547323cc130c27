"""The real LightGaussian, unmodified, where ``FRAGPRUNE_HOSTS`` points at a folder with it."""

import pytest
from hosts.test_checkouts import each_of

from fragprune_light_gaussian import LightGaussian

pytestmark = [pytest.mark.slow, pytest.mark.timeout(900)]
every_host = each_of(LightGaussian())


RUN = """
import contextlib, json, sys
from pathlib import Path
from types import ModuleType
import torch
torch.set_num_threads(1)
from fragprune_plugins.files import sidecar
from fragprune_plugins.injection.launch import RunOptions, run
from fragprune_plugins.files.ply import read_ply
from fragprune_plugins.learning.schedule import Settings

def absent(name, **members):
    try:
        __import__(name)
    except Exception:  # torchvision is not made for every torch
        sys.modules[name] = module = ModuleType(name)
        module.__path__ = []
        vars(module).update(members)

absent("icecream", ic=lambda *values: None)
absent("torchvision", models=None, utils=None)  # only evaluations and pictures need it

host, data, out = (Path(argument) for argument in sys.argv[1:4])
NAMES = ("xyz", "f_dc", "f_rest", "opacity", "scaling", "rotation")

def command(script, folder, *more):
    words = [str(host / script), "-s", str(data), "-m", str(folder), "--eval", "-r", "1"]
    words += "--sh_degree 1 --test_iterations -1 --port 0".split()
    return words + [str(word) for word in more]

def train(stage, *more):
    words = "--iterations 30 --densify_from_iter 5 --densification_interval 10".split()
    words += "--densify_until_iter 15 --densify_grad_threshold 0.002".split()
    words += "--prune_iterations 20 33 --prune_percent 0.3".split()
    settings = Settings(iterations=10, threshold_lr=0.3, train="opacity")
    options = RunOptions(device="cpu", stage=stage, settings=settings)
    return run(command("train_densify_prune.py", out / "a", *words, *more), options)

def row_of(model):
    columns = [getattr(model, name).reshape(len(model.xyz), -1) for name in NAMES]
    return [row.tobytes() for row in torch.cat(columns, dim=1).numpy()]

def pruned(name, *more):
    words = command("prune_finetune.py", out / name, "--prune_percent", 0.3, *more)
    run(words, RunOptions(device="cpu", stage="off"))
    (file,) = (out / name).glob("point_cloud/*/point_cloud.ply")
    model, store = read_ply(file), sidecar.load(file)[0]
    where = {row: index for index, row in enumerate(row_of(after))}
    rows = torch.tensor([where[row] for row in row_of(model)])
    return [len(rows), len(store), torch.equal(store.logits, first.logits[rows])]

with contextlib.redirect_stdout(sys.stderr):
    summary = train("auto", "--checkpoint_iterations", 40)
    before, after = read_ply(summary.model_before), read_ply(summary.model_after)
    first = sidecar.load(summary.model_after)[0]
    checkpoint = out / "a" / "chkpnt40.pth"
    one_later = ("--iterations", 42, "--prune_iterations", 41)
    cloud = ("--iterations", 2, "--prune_iterations", 1)
    report = {
        "moved": [n for n in NAMES if not torch.equal(getattr(before, n), getattr(after, n))],
        "rows": [len(before.xyz), len(after.xyz), len(first)],
        "fragments": [summary.fragments_before, summary.fragments_after],
        "checkpoint": pruned("b", "--start_checkpoint", checkpoint, *one_later),
        "point cloud": pruned("c", "--start_pointcloud", summary.model_after, *cloud),
    }
print(json.dumps(report))
"""


@every_host
def test_thresholds_are_learned_and_stay_with_the_survivors_of_pruning(
    host, dataset, tmp_path, python
):
    report = python(RUN, host, dataset, tmp_path)
    assert report["moved"] == ["opacity"]
    (rows,) = set(report["rows"])  # though stage 2 passes an iteration to prune at
    before, after = report["fragments"]
    assert after < before
    for start in ("checkpoint", "point cloud"):
        left, thresholds, aligned = report[start]
        assert left == thresholds == rows - int(0.3 * (rows - 1)) - 1
        assert aligned
