"""Draws views of finished 4DGaussians models by the host's own render, and times it.

python 4dgaussians_frames.py CHECKOUT MODEL... [--data FOLDER] [--enlarge 4] [--device cpu]

MODEL is a folder out/point_cloud/iteration_N. Thresholds beside its PLY apply. The models draw in
turns, each view of each once a round. They draw the test views of the first model's training, or
with --data all training views of another data set.
"""

from __future__ import annotations

import ast
import contextlib
import statistics
import sys
import time
from argparse import ArgumentParser, Namespace
from collections.abc import Iterator
from importlib.util import find_spec
from pathlib import Path
from types import ModuleType
from typing import Any
from unittest import mock

import torch

import fragprune_plugins
from fragprune_plugins.injection.process import surroundings
from fragprune_plugins.workbench.figures.metrics import psnr, ssim

parser = ArgumentParser()
parser.add_argument("checkout", type=Path)
parser.add_argument("models", type=Path, nargs="+")
parser.add_argument("--data", type=Path, help="draw the training views of this data set")
parser.add_argument("--enlarge", type=int, default=1, help="timed frames are this much larger")
parser.add_argument("--rounds", type=int, default=7)
parser.add_argument("--device", default="cuda", help="cpu, or cuda")
args = parser.parse_args()

session = fragprune_plugins.activate(host=args.checkout, stage="off")  # above the host's imports
for name, members in session.dialect.unneeded.items():
    if find_spec(name) is None:
        sys.modules[name] = ModuleType(name)
        vars(sys.modules[name]).update(members)
sys.path.insert(0, str(args.checkout))


def written(folder: Path) -> Namespace:
    """The arguments of the training that wrote a model, configuration included."""
    call = ast.parse((folder.parents[1] / "cfg_args").read_text(), mode="eval").body
    assert isinstance(call, ast.Call)
    return Namespace(**{str(word.arg): ast.literal_eval(word.value) for word in call.keywords})


def load(folder: Path) -> Any:
    """A model with its network and its thresholds."""
    from scene import GaussianModel

    given = written(folder)
    model = GaussianModel(given.sh_degree, given)
    model.load_ply(str(folder / "point_cloud.ply"))
    model.load_model(str(folder))
    return model


def milliseconds() -> float:
    """Milliseconds: the wall's on a GPU, else of this process, which load disturbs less."""
    if args.device != "cpu":
        torch.cuda.synchronize()
    return 1e3 * (time.process_time() if args.device == "cpu" else time.perf_counter())


@contextlib.contextmanager
def counted(engine: Any) -> Iterator[list[float]]:
    """Inside, fragments per pixel of each view that our engine draws are noted."""
    rasterize, fragments = engine.rasterize, []

    def noting(*given: Any) -> Any:
        outputs = rasterize(*given)
        fragments.append(float(outputs.fragments_per_pixel))
        return outputs

    with mock.patch.object(engine, "rasterize", noting):
        yield fragments


@torch.no_grad()
def main() -> None:
    """Print quality at the photographs' size, then frame times."""
    from gaussian_renderer import render
    from scene import GaussianModel, Scene

    given = written(args.models[0])
    given.source_path = str(args.data or given.source_path)
    scene = Scene(given, GaussianModel(given.sh_degree, given), shuffle=False)
    cameras = list(scene.getTrainCameras() if args.data else scene.getTestCameras())
    models = [load(folder) for folder in args.models]
    background = torch.full((3,), float(given.white_background), device="cuda")

    def draw(camera: Any, model: Any) -> Any:
        return render(camera, model, given, background, cam_type=scene.dataset_type)["render"]

    for folder, model in zip(args.models, models, strict=True):
        with counted(session.engine(background.device)) as fragments:
            pairs = [(draw(c, model).clamp(0, 1), c.original_image[:3].cuda()) for c in cameras]
        quality, likeness = (statistics.fmean(f(*pair) for pair in pairs) for f in (psnr, ssim))
        each = f"{statistics.fmean(fragments):.2f} fragments per pixel, " if fragments else ""
        print(
            f"{folder}: {len(model.get_xyz)} Gaussians, {each}{quality:.2f} dB, SSIM {likeness:.4f}"
        )

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
                begun = milliseconds()
                draw(camera, model)
                mine.append(milliseconds() - begun)
        if turn:  # the first warms up
            for mine, total in zip(rounds, times, strict=True):
                total.append(statistics.median(mine))
    first = times[0]
    print(f"{len(cameras)} views of {cameras[0].image_width}x{cameras[0].image_height} pixels")
    for folder, mine in zip(args.models, times, strict=True):
        faster = statistics.median(a / b for a, b in zip(first, mine, strict=True))
        print(f"{folder}: {statistics.median(mine):.2f} ms, least {min(mine):.2f}, {faster:.2f}x")


with surroundings(args.device):
    main()
