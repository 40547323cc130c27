"""Draws the held-out views of finished RT-4DGS models by the host's own render, and times it.

python rt_4dgs_frames.py CHECKOUT CONFIG CHECKPOINT... [--enlarge 4] [--device cpu]

CONFIG is the YAML file of the training. Thresholds inside a checkpoint apply. The models draw in
turns, each view of each once a round.
"""

from __future__ import annotations

import statistics
import sys
import time
from argparse import ArgumentParser, Namespace
from pathlib import Path
from typing import Any

import torch

import fragprune_plugins
from fragprune_plugins.injection.process import surroundings
from fragprune_plugins.workbench.figures.metrics import psnr, ssim

parser = ArgumentParser()
parser.add_argument("checkout", type=Path)
parser.add_argument("config", type=Path)
parser.add_argument("checkpoints", type=Path, nargs="+")
parser.add_argument("--enlarge", type=int, default=1, help="timed frames are this much larger")
parser.add_argument("--rounds", type=int, default=7)
parser.add_argument("--device", default="cuda", help="cpu, or cuda")
args = parser.parse_args()

fragprune_plugins.activate(host=args.checkout, stage="off")  # above the host's imports
sys.path.insert(0, str(args.checkout))


def held_out(given: Namespace) -> list[Any]:
    """The host's cameras of the held-out views, with their photographs."""
    from scene.dataset_readers import readCamerasFromTransforms
    from utils.camera_utils import cameraList_from_camInfos

    read = readCamerasFromTransforms(
        given.source_path,
        "transforms_test.json",
        given.white_background,
        given.extension,
        given.time_duration,
    )
    return [camera.cuda() for camera in cameraList_from_camInfos(read, 1.0, given)]


def load(checkpoint: Path, given: Namespace) -> Any:
    """A model with its thresholds."""
    from scene import GaussianModel

    model = GaussianModel(
        given.sh_degree,
        gaussian_dim=4,
        time_duration=given.time_duration,
        rot_4d=given.rot_4d,
        sh_degree_t=2 if given.eval_shfs_4d else 0,
    )
    model.restore(torch.load(checkpoint)[0], None)
    return model


@torch.no_grad()
def main() -> None:
    """Print quality at the photographs' size, then frame times."""
    from arguments import ModelParams, PipelineParams
    from gaussian_renderer import render

    from fragprune_rt_4dgs.config import YAMLFile

    host = ArgumentParser()
    model_flags, pipeline_flags = ModelParams(host), PipelineParams(host)
    values = {"time_duration": [-0.5, 0.5], "rot_4d": False} | vars(host.parse_args([]))
    given = Namespace(**(values | YAMLFile("--config").read(args.config)))
    pipeline = pipeline_flags.extract(given)
    vars(given).update(vars(model_flags.extract(given)))
    cameras, models = held_out(given), [load(path, given) for path in args.checkpoints]
    background = torch.full((3,), float(given.white_background), device="cuda")
    wait = torch.cuda.synchronize
    for path, model in zip(args.checkpoints, models, strict=True):
        images = [render(camera, model, pipeline, background)["render"] for camera in cameras]
        pairs = [(i.clamp(0, 1), c.image) for i, c in zip(images, cameras, strict=True)]
        quality, likeness = (statistics.fmean(f(*pair) for pair in pairs) for f in (psnr, ssim))
        print(f"{path}: {len(model.get_xyz)} Gaussians, {quality:.2f} dB, SSIM {likeness:.4f}")

    for camera in cameras:
        camera.image_width *= args.enlarge
        camera.image_height *= args.enlarge
    times: list[list[float]] = [[] for _ in models]
    order = list(range(len(models)))
    for turn in range(args.rounds + 1):
        rounds: list[list[float]] = [[] for _ in models]
        for camera in cameras:
            order.reverse()  # none is always the one that finds a cold cache
            for model, mine in ((models[i], rounds[i]) for i in order):
                wait()
                begun = time.perf_counter()
                render(camera, model, pipeline, background)
                wait()
                mine.append(1e3 * (time.perf_counter() - begun))
        if turn:  # the first warms up
            for mine, total in zip(rounds, times, strict=True):
                total.append(statistics.median(mine))
    first = times[0]
    print(f"frames of {cameras[0].image_width}x{cameras[0].image_height} pixels")
    for path, mine in zip(args.checkpoints, times, strict=True):
        faster = statistics.median(a / b for a, b in zip(first, mine, strict=True))
        print(f"{path}: {statistics.median(mine):.2f} ms, least {min(mine):.2f}, {faster:.2f}x")


with surroundings(args.device):
    main()
