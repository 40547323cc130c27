"""A small script with the interface of gsplat's own trainer: flags, files, calls and their order.

python simple_trainer.py default|mcmc --data_dir IN --result_dir OUT [--max_steps 30] [--ckpt FILE]
"""

import argparse
import json
import random
from dataclasses import dataclass, fields
from pathlib import Path

import gsplat
import torch
from datasets.colmap import Parser
from fused_ssim import fused_ssim
from gsplat.distributed import cli
from gsplat.rendering import rasterization
from gsplat.strategy import DefaultStrategy, MCMCStrategy


@dataclass
class Config:
    data_dir: str = "data"
    data_factor: int = 4
    result_dir: str = "results"
    ckpt: str | None = None
    normalize_world_space: bool = True
    max_steps: int = 30_000
    eval_steps: str = "7000 30000"
    save_steps: str = "7000 30000"
    ply_steps: str = "7000 30000"
    save_ply: bool = False
    sparse_grad: bool = False
    viewer: str = ""
    strategy: str = "default"


def create_splats_with_optimizers(sparse_grad: bool, count: int = 60):
    generator = torch.Generator().manual_seed(0)

    def spread(*shape):
        return 2 * torch.rand(*shape, generator=generator) - 1

    tensors = {
        "means": (spread(count, 3) * 0.7, 1e-3),
        "scales": (torch.full((count, 3), -2.0), 5e-3),
        "quats": (spread(count, 4), 1e-3),
        "opacities": (torch.logit(torch.full((count,), 0.3)), 5e-2),
        "sh0": (spread(count, 1, 3), 2.5e-2),
        "shN": (torch.zeros(count, 3, 3), 1.25e-3),
    }
    splats = torch.nn.ParameterDict(
        {name: torch.nn.Parameter(value) for name, (value, _) in tensors.items()}
    ).to("cuda:0")
    kind = torch.optim.SparseAdam if sparse_grad else torch.optim.Adam
    optimizers = {
        name: kind([{"params": splats[name], "lr": rate, "name": name}], eps=1e-15)
        for name, (_, rate) in tensors.items()
    }
    return splats, optimizers


class Runner:
    def __init__(self, config):
        self.config, self.out = config, Path(config.result_dir)
        self.parser = Parser(config.data_dir, config.normalize_world_space)
        torch.manual_seed(42)
        random.seed(42)
        for folder in ("ckpts", "stats", "ply"):
            (self.out / folder).mkdir(parents=True, exist_ok=True)
        self.splats, self.optimizers = create_splats_with_optimizers(config.sparse_grad)
        kind = MCMCStrategy if config.strategy == "mcmc" else DefaultStrategy
        self.strategy = kind(refine_start_iter=4, refine_every=4, refine_stop_iter=20)
        self.strategy.check_sanity(self.splats, self.optimizers)
        self.state = self.strategy.initialize_state()
        self.views = torch.eye(4).repeat(4, 1, 1)
        self.views[:, 0, 3], self.views[:, 2, 3] = torch.linspace(-0.4, 0.4, 4), 3.0
        self.pictures = torch.rand(4, 20, 28, 3)

    def rasterize_splats(self, view):
        K = torch.tensor([[30.0, 0, 14], [0, 30.0, 10], [0, 0, 1]])
        return rasterization(
            means=self.splats["means"],
            quats=self.splats["quats"],
            scales=torch.exp(self.splats["scales"]),
            opacities=torch.sigmoid(self.splats["opacities"]),
            colors=torch.cat([self.splats["sh0"], self.splats["shN"]], 1),
            viewmats=self.views[view, None],
            Ks=K[None],
            width=28,
            height=20,
            sh_degree=1,
            packed=False,
        )

    def train(self):
        config = self.config
        decay = torch.optim.lr_scheduler.ExponentialLR(
            self.optimizers["means"], 0.01 ** (1 / config.max_steps)
        )
        photographs = torch.utils.data.DataLoader(range(3), shuffle=True)
        reading = iter(photographs)
        for step in range(config.max_steps):
            if step % 3 == 0:
                reading = iter(photographs)
            view = int(next(reading))
            colors, _, info = self.rasterize_splats(view)
            shared = (self.splats, self.optimizers, self.state, step, info)
            self.strategy.step_pre_backward(*shared)
            pair = colors.permute(0, 3, 1, 2), self.pictures[view, None].permute(0, 3, 1, 2)
            loss = (pair[0] - pair[1]).abs().mean() + 0.2 * (1 - fused_ssim(*pair, padding="valid"))
            loss.backward()
            if step + 1 in (config.max_steps, *map(int, config.save_steps.split())):
                saved = {"step": step, "splats": self.splats.state_dict()}
                torch.save(saved, f"{self.out}/ckpts/ckpt_{step}_rank0.pt")
            if config.save_ply and step + 1 in map(int, config.ply_steps.split()):
                export = getattr(gsplat, "export_splats", None)  # 1.4.0 has none
                if export:
                    export(**self.splats, save_to=f"{self.out}/ply/point_cloud_{step}.ply")
            for each in self.splats.values() if config.sparse_grad else ():
                each.grad = each.grad.to_sparse(1)
            for optimizer in self.optimizers.values():
                optimizer.step()
                optimizer.zero_grad(set_to_none=True)
            decay.step()
            mcmc = config.strategy == "mcmc"
            more = {"lr": decay.get_last_lr()[0]} if mcmc else {"packed": False}
            self.strategy.step_post_backward(*shared, **more)
            if step + 1 in map(int, config.eval_steps.split()):
                self.eval(step)

    @torch.no_grad()
    def eval(self, step):
        (view,) = torch.utils.data.DataLoader(range(3, 4))
        colors = self.rasterize_splats(int(view))[0]
        stats = {"mean": float(colors.mean()), "num_GS": len(self.splats["means"])}
        (self.out / "stats" / f"val_step{step:04d}.json").write_text(json.dumps(stats))


def main(local_rank, world_rank, world_size, config):
    runner = Runner(config)
    if config.ckpt is None:
        runner.train()
        if config.viewer:
            raise KeyboardInterrupt  # the viewer is open until then
        return None
    saved = torch.load(config.ckpt, map_location="cuda:0", weights_only=True)
    for name in runner.splats:
        runner.splats[name].data = saved["splats"][name]
    return runner.eval(step=saved["step"])


if __name__ == "__main__":
    parser = argparse.ArgumentParser()
    parser.add_argument("strategy")
    for field in fields(Config)[:-1]:
        spellings = {f"--{field.name}", f"--{field.name.replace('_', '-')}"}
        several = field.name.endswith("steps") and field.name != "max_steps"
        if field.type is bool:
            parser.add_argument(
                *spellings, default=field.default, action=argparse.BooleanOptionalAction
            )
        else:
            parser.add_argument(*spellings, default=field.default, nargs="+" if several else None)
    values = vars(parser.parse_args())
    values = {k: " ".join(v) if isinstance(v, list) else v for k, v in values.items()}
    config = Config(**values | {"max_steps": int(values["max_steps"])})
    assert config.data_dir
    cli(main, config, verbose=True)
