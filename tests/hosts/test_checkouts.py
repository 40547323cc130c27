"""Real checkouts, unmodified, where ``FRAGPRUNE_HOSTS`` points at a folder of them.

None is kept here: their licence is not ours. ``FRAGPRUNE_TEST_DATA`` may name a folder that holds
``fox/colmap160``, or is itself a COLMAP dataset; otherwise the demo's room is photographed.
"""

import json
import os
import shutil
from pathlib import Path

import pytest
from miniatures.skeletons import STATES

from fragprune_2dgs import SurfelSplatting
from fragprune_mcmc import MCMC
from fragprune_mip_splatting import MipSplatting
from fragprune_plugins.hosts.source import HostRepo
from fragprune_plugins.testing.conformance import found_adapter
from fragprune_rain_gs import RainGS
from fragprune_vanilla_3dgs import Vanilla3DGS

pytestmark = [pytest.mark.slow, pytest.mark.timeout(900)]

FOLDER = os.environ.get("FRAGPRUNE_HOSTS")


def checkouts(*adapters) -> list[Path]:
    """Folders that one of the adapters is for."""
    found = sorted(path for path in Path(FOLDER).iterdir() if path.is_dir()) if FOLDER else []
    return [p for p in found if any(adapter.match(HostRepo(p)).fits for adapter in adapters)]


def each_of(*adapters):
    """A test for every checkout that one of the adapters is for."""
    titles = " or ".join(adapter.info.title for adapter in adapters)
    reason = f"FRAGPRUNE_HOSTS names no folder with a checkout of {titles} in it"
    hosts = checkouts(*adapters) or [pytest.param(None, marks=pytest.mark.skip(reason=reason))]
    return pytest.mark.parametrize("host", hosts, ids=lambda path: path.name if path else "none")


every_vanilla = each_of(Vanilla3DGS())
every_host = each_of(Vanilla3DGS(), MCMC(), MipSplatting(), RainGS(), SurfelSplatting())
every_renderer = each_of(Vanilla3DGS(), MCMC(), MipSplatting())  # RAIN-GS's fails by itself


DIALECTS = {  # settings, and values that come back
    "2dgs": (12, 3),
    "4dgaussians": (12, 3),
    "light-gaussian": (13, 2),
    "mcmc": (12, 3),
    "mini-splatting": (12, 2),
    "mip-splatting": (14, 2),
    "rain-gs": (13, 3),
    "rt-4dgs": (18, 6),
}


@pytest.mark.parametrize("name", DIALECTS)
def test_every_dialect_is_read_and_vanillas_adapter_keeps_out(name):
    adapter = found_adapter(name)
    hosts = checkouts(adapter)
    if not hosts:
        pytest.skip(f"FRAGPRUNE_HOSTS names no folder with a checkout of {name} in it")
    for repo in map(HostRepo, hosts):
        dialect = adapter.dialect(repo)
        assert (len(dialect.settings), dialect.outputs) == DIALECTS[name]
        assert adapter.command_line(repo).default_iterations == 30_000
        assert not Vanilla3DGS().match(repo).fits


@every_vanilla
def test_the_state_of_vanilla_is_a_known_one(host):
    adapter, repo = Vanilla3DGS(), HostRepo(host)
    state = adapter.revision(repo)
    assert state in STATES
    dialect = adapter.dialect(repo)
    assert len(dialect.settings) == (13 if "2024" in state else 11 + (state != "mid-July 2023"))
    assert dialect.outputs == (3 if "2024" in state else 2)
    assert dialect.sparse_adam == (state == "October 2024")
    assert adapter.command_line(repo).default_iterations == 30_000


def flags(host: Path) -> list[str]:
    """What a host needs, or refuses, beyond the flags that all have."""
    repo = HostRepo(host)
    if MCMC().match(repo).fits:
        return ["--cap_max", "3100", "--init_type", "sfm"]
    return ["--port", "0", *(["--exp_name", "a"] if RainGS().match(repo).fits else [])]


TORCHVISION = """
import sys
from types import ModuleType
try:
    import torchvision
except Exception:  # it is not made for every torch; only pictures and LPIPS need it
    from PIL import Image
    package, tools = ModuleType("torchvision"), ModuleType("torchvision.utils")
    package.__path__, package.models = [], None
    def save_image(tensor, path):
        pixels = (tensor.detach().clamp(0, 1) * 255).byte().permute(1, 2, 0)
        Image.fromarray(pixels.cpu().numpy()).save(path)
    tools.save_image, package.utils = save_image, tools
    sys.modules.update({"torchvision": package, "torchvision.utils": tools})
"""

RUN = (
    TORCHVISION
    + """
import contextlib, json
from dataclasses import replace
from pathlib import Path
import torch
torch.set_num_threads(1)
from fragprune_plugins.files import sidecar
from fragprune_plugins.injection.launch import RunOptions, run
from fragprune_plugins.files.ply import read_ply
from fragprune_plugins.learning.schedule import Settings

host, data, out = (Path(argument) for argument in sys.argv[1:4])
train = sys.argv[4]
words = [str(host / "train.py"), "-s", str(data), "-m", str(out), "--eval", "-r", "1"]
words += "--iterations 30 --sh_degree 1 --densify_from_iter 5 --densification_interval 10".split()
words += "--densify_until_iter 25 --densify_grad_threshold 0.002 --test_iterations -1".split()
words += sys.argv[5:]
options = RunOptions(
    device="cpu", settings=Settings(iterations=10, train=train, threshold_lr=0.3)
)
with contextlib.redirect_stdout(sys.stderr):
    summary = run(words, replace(options))
    paths = (summary.model_before, summary.model_after)
    before, after = (read_ply(path, filtered=True) for path in paths)
    store, info = sidecar.load(summary.model_after)
    moved = [
        name
        for name in ("xyz", "f_dc", "f_rest", "opacity", "scaling", "rotation")
        if not torch.equal(getattr(before, name), getattr(after, name))
    ]
    report = {
        "moved": moved,
        "rows": [len(before.xyz), len(after.xyz), len(store), info.rows],
        "steps": [summary.iterations, store.steps],
        "neutral": store.neutral,
        "fragments": [summary.fragments_before, summary.fragments_after],
    }
print(json.dumps(report))
"""
)

MOVES = {  # f_rest is not drawn yet: hosts use a second band from iteration 1000 on
    "opacity": ["opacity"],
    "appearance": ["f_dc", "opacity"],
    "all": ["xyz", "f_dc", "opacity", "scaling", "rotation"],
}


@every_host
@pytest.mark.parametrize("train", MOVES)
def test_training_then_fine_tuning_moves_only_what_is_named(host, dataset, tmp_path, python, train):
    report = python(RUN, host, dataset, tmp_path / "out", train, *flags(host))
    assert report["moved"] == MOVES[train]
    assert len(set(report["rows"])) == 1
    assert report["steps"] == [10, 10]
    assert not report["neutral"]
    before, after = report["fragments"]
    assert after < before


RENDER = (
    TORCHVISION
    + """
import contextlib, hashlib, json
from pathlib import Path
import torch
torch.set_num_threads(1)
from fragprune_plugins.injection.launch import RunOptions, run
from fragprune_plugins.files import sidecar
host, out = Path(sys.argv[1]), Path(sys.argv[2])
def pictures():
    run([str(host / "render.py"), "-m", str(out), "--skip_train"], RunOptions(device="cpu"))
    found = sorted(out.glob("test/ours_*/*/*.png"))
    return [hashlib.sha256(path.read_bytes()).hexdigest() for path in found]
with contextlib.redirect_stdout(sys.stderr):
    with_thresholds = pictures()
    (beside,) = out.glob("point_cloud/*/*.safetensors")
    beside.unlink()
    without = pictures()
print(json.dumps([len(with_thresholds), with_thresholds != without]))
"""
)


@every_renderer
def test_the_hosts_own_render_script_applies_thresholds(host, dataset, tmp_path, python):
    python(RUN, host, dataset, tmp_path / "out", "opacity", *flags(host))
    count, differ = python(RENDER, host, tmp_path / "out")
    assert count > 0
    assert differ


FINETUNE = RUN.replace("replace(options)", 'replace(options, stage="finetune")')


@every_vanilla
def test_exposures_of_a_late_host_come_through_stage_two_unchanged(host, dataset, tmp_path, python):
    if "2023" in Vanilla3DGS().revision(HostRepo(host)):
        pytest.skip("this state has no exposures")
    out = tmp_path / "out"
    python(RUN, host, dataset, out, "opacity", *flags(host), "--train_test_exp")
    final = json.loads((out / "exposure.json").read_text())
    identity = [[float(i == j) for j in range(4)] for i in range(3)]
    assert any(value != identity for value in final.values())
    second = tmp_path / "second"
    shutil.copytree(out, second)
    python(FINETUNE, host, dataset, second, "opacity", *flags(host), "--train_test_exp")
    assert json.loads((second / "exposure.json").read_text()) == final
