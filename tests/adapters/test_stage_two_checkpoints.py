"""A checkpoint that the host writes in stage 2 is the host's: from it everything trains again."""

import shutil
from dataclasses import replace
from functools import partial
from pathlib import Path

import pytest
import torch
from miniatures import runs
from miniatures.vanilla_3dgs import HOST, run_script

from fragprune_plugins.hosts.source import HostRepo
from fragprune_plugins.injection.launch import RunOptions, run
from fragprune_plugins.injection.session import Session
from fragprune_plugins.learning.schedule import Settings
from fragprune_plugins.plugins.loading import load_plugins
from fragprune_vanilla_3dgs import Vanilla3DGS

NAMES = ("xyz", "f_dc", "f_rest", "scaling", "rotation", "opacity")
command = partial(runs.command, HOST / "train.py")
SETTINGS = Settings(iterations=8, threshold_lr=0.3, train="opacity")
OPTIONS = RunOptions(device="cpu", settings=SETTINGS)
EVERYTHING = {"xyz", "f_dc", "scaling", "rotation", "opacity"}  # a second band comes much later


def parameters(checkpoint):
    capture, _ = torch.load(checkpoint, weights_only=False)
    return dict(zip(NAMES, capture[1:7], strict=True))


def rates(checkpoint):
    groups = torch.load(checkpoint, weights_only=False)[0][10]["param_groups"]
    return {group["name"]: group["lr"] for group in groups if group["name"] != "xyz"}


def moved(before, after):
    one, other = parameters(before), parameters(after)
    return {name for name in NAMES if not torch.equal(one[name], other[name])}


@pytest.fixture(scope="module")
def trained(photographs, tmp_path_factory):
    """Twelve iterations and eight of stage 2; checkpoints of iterations 12 and 16."""
    out = tmp_path_factory.mktemp("trained")
    run(command(photographs, out, 12, "--checkpoint_iterations", 16), OPTIONS)
    assert moved(out / "chkpnt12.pth", out / "chkpnt16.pth") == {"opacity"}
    return out


@pytest.mark.parametrize("stage", ["alone", "off", "joint", "finetune"])
def test_everything_trains_that_would_have_trained(photographs, trained, tmp_path, stage):
    start, out = trained / "chkpnt16.pth", tmp_path / "out"
    more = ["--start_checkpoint", start, "--checkpoint_iterations", 23]
    words = command(photographs, out, 24, *more)
    if stage == "alone":
        session = Session(Vanilla3DGS(), HostRepo(HOST), load_plugins(), drop_in=True)
        run_script(words, session, activated=False)
    else:
        settings = replace(SETTINGS, train="all")
        run(words, replace(OPTIONS, stage=stage, settings=settings))
    assert moved(start, out / "chkpnt23.pth") == EVERYTHING


def test_it_holds_the_hosts_parameters_and_rates_as_the_host_has_them(trained):
    host, ours = trained / "chkpnt12.pth", trained / "chkpnt16.pth"
    assert all(parameter.requires_grad for parameter in parameters(ours).values())
    assert rates(ours) == rates(host)


def test_so_does_one_of_a_stage_two_that_began_from_a_ply(photographs, trained, tmp_path):
    start = Path("point_cloud/iteration_12/point_cloud.ply")
    (tmp_path / start).parent.mkdir(parents=True)
    shutil.copy(trained / start, tmp_path / start)
    words = command(photographs, tmp_path, 12, "--checkpoint_iterations", 16)
    run(words, replace(OPTIONS, stage="finetune"))
    assert all(p.requires_grad for p in parameters(tmp_path / "chkpnt16.pth").values())
    assert rates(tmp_path / "chkpnt16.pth") == rates(trained / "chkpnt12.pth")
