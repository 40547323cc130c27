"""The real Mini-Splatting, unmodified, where ``FRAGPRUNE_HOSTS`` points at a folder with it."""

import pytest
from hosts.test_checkouts import each_of

from fragprune_mini_splatting import MiniSplatting

pytestmark = [pytest.mark.slow, pytest.mark.timeout(1800)]
every_host = each_of(MiniSplatting())


RUN = """
import contextlib, json, sys
from pathlib import Path
from types import ModuleType, SimpleNamespace
import torch
torch.set_num_threads(1)
from fragprune_plugins.files import sidecar
from fragprune_plugins.injection.launch import RunOptions, run
from fragprune_plugins.files.ply import read_ply
from fragprune_plugins.learning.schedule import Settings

def no_weights(*given, **named):
    raise OSError("not downloaded in a test")

torch.hub.load_state_dict_from_url = no_weights
try:
    import torchvision
except Exception:  # it is not made for every torch; only evaluations and pictures need it
    sys.modules["torchvision"] = module = ModuleType("torchvision")
    weights = SimpleNamespace(IMAGENET1K_V1=None)
    module.models = SimpleNamespace(VGG16_Weights=weights, vgg16=no_weights)

host, data, out, variant = (*(Path(argument) for argument in sys.argv[1:4]), sys.argv[4])
NAMES = ("xyz", "f_dc", "f_rest", "opacity", "scaling", "rotation")

def train(folder, stage, iterations, *more):
    words = [str(host / variant / "train.py"), "-s", str(data), "-m", str(folder), "--eval"]
    words += "-r 1 --sh_degree 1 --test_iterations -1 --port 0 --densify_from_iter 5".split()
    words += ["--iterations", str(iterations), *sys.argv[5:], *map(str, more)]
    settings = Settings(iterations=10, threshold_lr=0.3, train="opacity")
    start = 5 if stage == "joint" else None
    return run(words, RunOptions(device="cpu", stage=stage, from_iter=start, settings=settings))

with contextlib.redirect_stdout(sys.stderr):
    first = train(out / "a", "off", 30, "--checkpoint_iterations", 30)
    capture, _ = torch.load(out / "a/chkpnt30.pth", weights_only=False)
    torch.save((capture, 4990), out / "a/chkpnt4990.pth")  # so that 5,000 is near
    again = ("--start_checkpoint", out / "a/chkpnt4990.pth", "--checkpoint_iterations", 5035)
    train(out / "b", "off", 5035, *again)
    summary = train(out / "b", "finetune", 5035)
    before, after = read_ply(summary.model_before), read_ply(summary.model_after)
    store = sidecar.load(summary.model_after)[0]
    trained = len(capture[1])
    report = {
        "moved": [n for n in NAMES if not torch.equal(getattr(before, n), getattr(after, n))],
        "rows": [len(before.xyz), len(after.xyz), len(store)],
        "trained": trained,
        "degree": after.sh_degree,
        "fragments": [summary.fragments_before, summary.fragments_after],
    }
    if variant == "ms":
        joint = train(out / "c", "joint", 5035, *again)
        model, thresholds = read_ply(joint.model_after), sidecar.load(joint.model_after)[0]
        report["joint"] = [len(model.xyz), len(thresholds), thresholds.neutral]
print(json.dumps(report))
"""

FLAGS = {
    "gs": "--densification_interval 10 --densify_until_iter 15 --densify_grad_threshold 0.002",
    "ms": "--densification_interval 10 --densify_until_iter 5015 --densify_grad_threshold 0.002 "
    "--simp_iteration1 5015 --simp_iteration2 5025 --num_max 3000 --num_depth 900 "
    "--imp_metric outdoor",
    "ms_d": "--densification_interval 10 --densify_until_iter 5015 --densify_grad_threshold 0.002 "
    "--num_depth 900",
}


@every_host
@pytest.mark.parametrize("variant", FLAGS)
def test_thresholds_are_learned_after_points_made_anew(host, dataset, tmp_path, python, variant):
    report = python(RUN, host, dataset, tmp_path, variant, *FLAGS[variant].split())
    assert report["moved"] == ["opacity"]
    assert len(set(report["rows"])) == 1
    before, after = report["fragments"]
    assert after < before
    assert report["degree"] == 1
    if variant != "gs":
        assert report["rows"][0] != report["trained"]  # all of them made anew from depth
    if variant == "ms":
        rows, thresholds, neutral = report["joint"]
        assert rows == thresholds
        assert not neutral
