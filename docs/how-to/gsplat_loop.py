"""A training loop with gsplat, as its documentation has it, and stage 2 in three lines more.

python gsplat_loop.py SCENE OUT [--strategy mcmc] [--steps 3000] [--stage2 1000]
python gsplat_loop.py SCENE OUT --start MODEL.ply        (trained already: stage 2 alone)

SCENE is a COLMAP folder with sparse/0/points3D.txt. OUT gets trained.ply and finetuned.ply, the
thresholds beside the latter.
"""

from __future__ import annotations

import math
import random
from argparse import ArgumentParser
from pathlib import Path
from typing import Any

import fragprune_plugins
from fragprune_plugins.learning.goals import Control, Pressure
from fragprune_plugins.learning.schedule import Settings

parser = ArgumentParser()
parser.add_argument("scene", type=Path)
parser.add_argument("out", type=Path)
parser.add_argument("--start", type=Path, help="a trained model, for no --steps")
parser.add_argument("--strategy", choices=["default", "mcmc"], default="default")
parser.add_argument("--steps", type=int, default=3000)
parser.add_argument("--stage2", type=int, default=1000)
parser.add_argument("--cap", type=int, default=8000, help="Gaussians of --strategy mcmc")
parser.add_argument("--grow", type=float, default=2e-4, help="gradient that densifies")
parser.add_argument("--control", action="store_true", help="stage 2 without thresholds")
args = parser.parse_args()
args.steps = 0 if args.start else args.steps

# 1. Above the import of gsplat. Learning and freezing begin once the loop has made --steps steps.
settings = Settings(iterations=args.stage2, goal=Pressure() if not args.control else Control())
session = fragprune_plugins.activate("gsplat", from_iter=args.steps, settings=settings)

import gsplat  # noqa: E402
import numpy as np  # noqa: E402
import torch  # noqa: E402
from scipy.spatial import cKDTree  # noqa: E402

from fragprune_plugins.files.model import Model  # noqa: E402
from fragprune_plugins.files.ply import read_ply  # noqa: E402
from fragprune_plugins.types import View  # noqa: E402
from fragprune_plugins.workbench.finetune.losses import photometric_loss  # noqa: E402
from fragprune_plugins.workbench.models.formats.ply import write_ply  # noqa: E402
from fragprune_plugins.workbench.scenes.dataset import load_dataset  # noqa: E402

SH_DEGREE = 1
device = "cuda" if torch.cuda.is_available() else "cpu"
random.seed(0)
torch.manual_seed(0)

dataset = load_dataset(args.scene)
rows = (args.scene / "sparse/0/points3D.txt").read_text().splitlines()
cloud = np.array([row.split()[1:7] for row in rows if not row.startswith("#")], dtype=float)
points, colors = cloud[:, :3], cloud[:, 3:] / 255
spacing = np.sqrt(np.square(cKDTree(points).query(points, k=4)[0][:, 1:]).mean(axis=1))
mcmc = args.strategy == "mcmc"

count, bands = len(points), (SH_DEGREE + 1) ** 2
start = {
    "means": torch.tensor(points),
    "scales": torch.tensor(np.log(spacing.clip(1e-7) * (0.1 if mcmc else 1.0)))[:, None].repeat(
        1, 3
    ),
    "quats": torch.tensor([1.0, 0, 0, 0]).repeat(count, 1),
    "opacities": torch.full((count,), math.log(1.0) if mcmc else math.log(0.1 / 0.9)),
    "sh0": torch.tensor((colors - 0.5) / 0.28209479)[:, None],
    "shN": torch.zeros(count, bands - 1, 3),
}
if args.start:
    trained = read_ply(args.start)
    start = {
        "means": trained.xyz,
        "scales": trained.scaling,
        "quats": trained.rotation,
        "opacities": trained.opacity[:, 0],
        "sh0": trained.f_dc,
        "shN": trained.f_rest,
    }
    SH_DEGREE = trained.sh_degree
rates = {
    "means": 1.6e-4 * dataset.extent,
    "scales": 5e-3,
    "quats": 1e-3,
    "opacities": 5e-2,
    "sh0": 2.5e-3,
    "shN": 1.25e-4,
}
params = torch.nn.ParameterDict(
    {name: torch.nn.Parameter(value.float().to(device)) for name, value in start.items()}
)
optimizers = {
    name: torch.optim.Adam([params[name]], lr=rate, eps=1e-15) for name, rate in rates.items()
}
decay = torch.optim.lr_scheduler.ExponentialLR(
    optimizers["means"], 0.01 ** (1 / max(1, args.steps))
)
strategy = (
    gsplat.MCMCStrategy(cap_max=args.cap, refine_stop_iter=args.steps * 5 // 6)
    if mcmc
    else gsplat.DefaultStrategy(grow_grad2d=args.grow, refine_stop_iter=args.steps // 2)
)
strategy.check_sanity(params, optimizers)  # 2. here the model gets its thresholds
state = strategy.initialize_state()


def draw(view: View) -> tuple[torch.Tensor, dict[str, Any]]:
    """One view of the model as it is: (image (3, H, W), info)."""
    focal = view.width / (2 * view.tan_fov_x), view.height / (2 * view.tan_fov_y)
    K = torch.tensor([[focal[0], 0, view.width / 2], [0, focal[1], view.height / 2], [0, 0, 1]])
    image, _, info = gsplat.rasterization(
        params["means"],
        params["quats"],
        params["scales"].exp(),
        params["opacities"].sigmoid(),
        torch.cat([params["sh0"], params["shN"]], dim=1),
        view.viewmatrix.T[None].to(device),
        K[None].to(device),
        view.width,
        view.height,
        sh_degree=SH_DEGREE,
        packed=False,
    )
    return image[0].permute(2, 0, 1), info


def held_out() -> float:
    """Mean PSNR in dB over the views that were not trained on."""
    with torch.no_grad():
        errors = [
            (draw(shot.view)[0].clamp(0, 1) - shot.image.to(device)).square().mean()
            for shot in dataset.test
        ]
    return float(-10 * torch.stack(errors).log10().mean())


def export(name: str) -> None:
    """A PLY; thresholds that were learned go beside it."""
    args.out.mkdir(parents=True, exist_ok=True)
    path, tensors = args.out / f"{name}.ply", {k: each.detach() for k, each in params.items()}
    if hasattr(gsplat, "export_splats"):
        gsplat.export_splats(**tensors, save_to=str(path))
    else:  # gsplat 1.4 writes no PLY
        names = ("means", "sh0", "shN", "opacities", "scales", "quats")
        xyz, f_dc, f_rest, opacity, scaling, rotation = (tensors[each].cpu() for each in names)
        write_ply(path, Model(xyz, f_dc, f_rest, opacity[:, None], scaling, rotation))
        session.save(params, path)


for step in range(args.steps + args.stage2):
    if step == args.steps:
        print(f"{step} steps: {len(params['means'])} Gaussians, {held_out():.3f} dB")
        export("trained")
    shot = random.choice(dataset.train)
    image, info = draw(shot.view)
    loss = photometric_loss(image, shot.image.to(device))
    if mcmc:
        loss = loss + 0.01 * params["opacities"].sigmoid().mean()
        loss = loss + 0.01 * params["scales"].exp().mean()
    strategy.step_pre_backward(params, optimizers, state, step, info)
    loss.backward()
    for optimizer in optimizers.values():
        optimizer.step()
        optimizer.zero_grad(set_to_none=True)
    more = {"lr": decay.get_last_lr()[0]} if mcmc else {}
    strategy.step_post_backward(params, optimizers, state, step, info, **more)
    if step < args.steps:
        decay.step()
    if step % 100 == 0:
        print(f"step {step}: {len(params['means'])} Gaussians, loss {float(loss.detach()):.4f}")

print(f"{args.steps + args.stage2} steps: {held_out():.3f} dB")
export("finetuned")
summary = session.finish()  # 3. what was gained, over the training views
if not args.control:
    print(f"fragments per pixel: {summary.fragments_before} -> {summary.fragments_after}")
