"""gsplat's checkouts with their own trainer, unmodified, where ``FRAGPRUNE_HOSTS`` points at them.

Its packages are not ours to require: the readers of COLMAP's files, tyro, torchmetrics and others
(``fragprune run`` names what is missing). Until 1.5 the reader needs numpy below 2, and a COLMAP
model in binary files: name one by ``FRAGPRUNE_TEST_DATA``.
"""

import json
import os
import subprocess
import sys
from pathlib import Path

import pytest
import torch
from installed.gsplat_host import releases

from fragprune_plugins.files import sidecar

pytestmark = [pytest.mark.slow, pytest.mark.timeout(900)]

TRAINER = Path("examples", "simple_trainer.py")
FOUND = {name: path for name, path in releases().items() if (path / TRAINER).exists()}
HOSTS = FOUND.values() or [
    pytest.param(None, marks=pytest.mark.skip(reason="FRAGPRUNE_HOSTS has no checkout of gsplat"))
]


@pytest.mark.parametrize("strategy", ["default", "mcmc"])
@pytest.mark.parametrize("checkout", HOSTS, ids=FOUND.keys() or ["none"])
def test_the_trainer_runs_unmodified_learns_and_evaluates(checkout, strategy, dataset, tmp_path):
    out = tmp_path / "out"

    def trainer(*words):
        line = [sys.executable, "-m", "fragprune_plugins", "run", "--device", "cpu"]
        line += ["--iters", "60", "--json", "--", checkout / TRAINER, strategy]
        line += ["--data_dir", dataset, "--data_factor", "1", "--result_dir", out]
        line += ["--disable_viewer", "--max_steps", "240", *words]
        path = os.pathsep.join([str(checkout), os.environ.get("PYTHONPATH", "")])
        done = subprocess.run(
            [str(word) for word in line],
            capture_output=True,
            text=True,
            env={**os.environ, "PYTHONPATH": path},
        )
        assert done.returncode == 0, (done.stdout, done.stderr[-4000:])
        return json.loads(done.stdout)

    report = trainer()
    after, ply = out / "ckpts" / "ckpt_299_rank0.pt", out / "ply" / "point_cloud_299.ply"
    saved = ply if ply.exists() else after  # 1.4.0 saves checkpoints alone
    assert (report["iterations"], report["model_after"]) == (60, str(saved))
    for at, model in ((239, "before"), (299, "after")) if ply.exists() else ():
        own = json.loads((out / "stats" / f"val_step{at:04d}.json").read_text())
        # the script saves its PLY one step before it measures
        assert report[model]["psnr"] == pytest.approx(own["psnr"], abs=0.1)
    rows = len(torch.load(after, weights_only=True)["splats"]["means"])
    store, info = sidecar.load(after, rows)
    assert (info.adapter, store.steps, store.neutral) == ("gsplat", 59, False)
    drawn = []
    for _ in range(2):
        assert trainer("--ckpt", after)["iterations"] == 0
        drawn.append(json.loads((out / "stats" / "val_step0299.json").read_text())["psnr"])
        sidecar.path_beside(after).unlink(missing_ok=True)
    assert drawn[0] != drawn[1]  # with thresholds, then without
