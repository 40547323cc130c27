"""A miniature Compact-3DGS: the demo's host with a mask, codebooks and a network for colours."""

import inspect
from importlib import import_module
from pathlib import Path
from typing import Any

import numpy as np
import torch

from fragprune_plugins.testing.host import Action, Chance
from miniatures.family import (
    BACKWARD,
    MODEL,
    OPTIONS,
    RENDERER,
    SCENE,
    STEP,
    TRAIN,
    Derived,
    Growth,
    adding,
)

NETWORK = '''"""Colours of places and directions, and codebooks; each network's weights lie flat."""

import torch
from torch import nn


def fixed(count):
    return nn.Parameter(torch.sin(torch.arange(count).float() ** 2))


class HashGrid(nn.Module):
    """Places (N, 3) -> features (N, 4)."""

    def __init__(self, cells):
        super().__init__()
        self.params = fixed(4 * cells)

    def forward(self, xyz):
        cells = self.params.view(-1, 4)
        primes = torch.tensor([1, 7, 31], device="cuda")
        return cells[((3 * xyz).floor().long() * primes).sum(dim=1) % len(cells)]


class Head(nn.Module):
    """Features (N, 4) and directions (N, 3) -> one band of colours (N, 1, 3)."""

    def __init__(self):
        super().__init__()
        self.params = fixed(21)

    def forward(self, features, directions):
        return (torch.cat([features, directions], dim=1) @ self.params.view(7, 3))[:, None]


class Codebook(nn.Module):
    """Entries, made from the first data that come."""

    def __init__(self, size, dim):
        super().__init__()
        self.register_buffer("initted", torch.tensor([False]))
        self.embed = nn.Parameter(torch.zeros(size, dim))


class Layer(nn.Module):
    """Each row becomes its nearest entry; while training, entries learn by a step of their own."""

    def __init__(self, size, dim):
        super().__init__()
        self._codebook = Codebook(size, dim)
        self.optimizer = torch.optim.Adam(self.parameters(), lr=1e-4)

    def forward(self, x):
        book, rows = self._codebook, x.detach()
        if not book.initted:
            chosen = torch.randint(len(rows), (len(book.embed),), device="cuda")
            book.embed.data, book.initted = rows[chosen].clone(), torch.tensor([True])
        index = torch.cdist(rows, book.embed.detach()).argmin(dim=1)
        if self.training and torch.is_grad_enabled():
            (book.embed[index] - rows).square().mean().backward()
            self.optimizer.step()
            self.optimizer.zero_grad()
        return book.embed.detach()[index], index


class ResidualVQ(nn.Module):
    """Layers, each for what the ones before left over; gradients pass straight through."""

    def __init__(self, dim, codebook_size, num_quantizers):
        super().__init__()
        self.layers = nn.ModuleList([Layer(codebook_size, dim) for _ in range(num_quantizers)])

    def forward(self, x):
        total, indices = torch.zeros_like(x), []
        for layer in self.layers:
            part, index = layer(x - total)
            total, indices = total + part, [*indices, index]
        return x + (total - x).detach(), torch.stack(indices, dim=-1), None
'''


class Added:
    def __init__(self, model):
        self.vanilla_init(0)
        self._mask = torch.empty(0)
        self.vq_scale = ResidualVQ(3, model.rvq_size, model.rvq_num).cuda()  # noqa: F821
        self.vq_rot = ResidualVQ(4, model.rvq_size, model.rvq_num).cuda()  # noqa: F821
        self.recolor, self.mlp_head = HashGrid(model.max_hashmap), Head()  # noqa: F821

    def capture(self):
        own = (self._xyz, self._scaling, self._rotation, self._opacity, self.max_radii2D)
        statistics = (self.xyz_gradient_accum, self.denom)
        state = self.optimizer.state_dict()
        return self.active_sh_degree, *own, *statistics, state, self.spatial_lr_scale

    def create_from_pcd(self, pcd, spatial_lr_scale):
        self.vanilla_create_from_pcd(pcd, spatial_lr_scale)
        self._adopt({"mask": torch.ones_like(self._opacity)})

    def training_setup(self, training_args):
        self.percent_dense = training_args.percent_dense
        self._reset_statistics()
        rate = training_args.position_lr_init * self.spatial_lr_scale
        rates = {
            "xyz": (self._xyz, rate),
            "opacity": (self._opacity, training_args.opacity_lr),
            "scaling": (self._scaling, training_args.scaling_lr),
            "rotation": (self._rotation, training_args.rotation_lr),
            "mask": (self._mask, training_args.mask_lr),
        }
        groups = [{"params": [p], "lr": lr, "name": name} for name, (p, lr) in rates.items()]
        self.optimizer = torch.optim.Adam(groups, lr=0.0, eps=1e-15)
        nets = [*self.recolor.parameters(), *self.mlp_head.parameters()]
        self.optimizer_net = torch.optim.Adam(nets, lr=training_args.net_lr, eps=1e-15)
        self.scheduler_net = torch.optim.lr_scheduler.MultiStepLR(
            self.optimizer_net, milestones=training_args.net_lr_step, gamma=0.33
        )
        self.xyz_scheduler_args = get_expon_lr_func(  # noqa: F821
            rate, rate / 100, training_args.position_lr_max_steps
        )

    def _adopt(self, tensors):
        for name, tensor in tensors.items():
            held = isinstance(tensor, nn.Parameter)  # noqa: F821
            parameter = tensor if held else nn.Parameter(tensor.requires_grad_(True))  # noqa: F821
            setattr(self, f"_{name}", parameter)

    def mask_prune(self):
        self.prune_points((torch.sigmoid(self._mask) <= 0.01).squeeze(-1))

    def sort_morton(self):
        with torch.no_grad():
            order = self._xyz.sum(dim=1).sort().indices
            for name in ("_xyz", "_opacity", "_scaling", "_rotation"):
                setattr(self, name, nn.Parameter(getattr(self, name)[order]))  # noqa: F821

    def final_prune(self, compress=False):
        self.mask_prune()
        if compress:
            self.sort_morton()
        for layer in (*self.vq_scale.layers, *self.vq_rot.layers):
            layer.training = False
        self._xyz = self._xyz.clone().half().float()
        self._scaling, self.sca_idx, _ = self.vq_scale(self.get_scaling)
        self._rotation, self.rot_idx, _ = self.vq_rot(self.get_rotation)
        self._opacity = self.get_opacity.clone().half().float()

    def precompute(self):
        self._feature = self.recolor(self._xyz.detach())

    def construct_list_of_attributes(self):
        scales, rotations = (f"scale_{i}" for i in range(3)), (f"rot_{i}" for i in range(4))
        return ["x", "y", "z", "nx", "ny", "nz", "opacity", *scales, *rotations]

    def _stored(self):
        tensors = (self._xyz, self._opacity, self._scaling, self._rotation)
        nets = (self.recolor.params, self.mlp_head.params)
        return [tensor.detach().cpu().numpy() for tensor in (*tensors, *nets)]

    def save_npz(self, path):
        Path(path).parent.mkdir(parents=True, exist_ok=True)
        np.savez(path, *self._stored())

    def save_npz_pp(self, path):
        Path(path).parent.mkdir(parents=True, exist_ok=True)
        np.savez_compressed(path + "_pp", *self._stored())

    def load_model(self, path):
        self.load_ply(path)

    def load_ply(self, path):
        vertex = PlyData.read(path + ".ply")["vertex"]  # noqa: F821
        names = [name for name in self.construct_list_of_attributes() if name[0] != "n"]
        table = torch.tensor(np.stack([np.asarray(vertex[name]) for name in names], axis=1))
        parts = [part.contiguous() for part in table.split((3, 1, 3, 4), dim=1)]
        self._adopt(dict(zip(("xyz", "opacity", "scaling", "rotation"), parts, strict=True)))
        nets = nn.ModuleList([self.recolor, self.mlp_head])  # noqa: F821
        nets.load_state_dict(torch.load(path + ".pth"))


def stored(scene, iteration, compress, store):
    """The model in one of its three forms."""
    folder = Path(scene.model_path) / "point_cloud" / f"iteration_{iteration}"
    model, path = scene.gaussians, str(folder / "point_cloud")
    if store:
        return model.save_npz_pp(path) if compress else model.save_npz(path)
    model.save_ply(f"{path}.ply")
    nets = torch.nn.ModuleList([model.recolor, model.mlp_head])
    return torch.save(nets.state_dict(), f"{path}.pth")


def after_densification(iteration, opt, gaussians):
    """Now and then, what the mask leaves out goes."""
    if iteration >= opt.densify_until_iter and iteration % opt.mask_prune_iter == 0:
        gaussians.mask_prune()


LOOK = """    away = torch.nn.functional.normalize(pc.get_xyz - viewpoint_camera.camera_center)
    if itr == -1:  # stored values once training is over
        scales, rotations, opacity = pc._scaling, pc._rotation, pc._opacity
        colours = pc.mlp_head(pc._feature, away)
    else:
        sure = torch.sigmoid(pc._mask)
        mask = ((sure > 0.01).float() - sure).detach() + sure
        scales, rotations = pc.get_scaling, pc.get_rotation
        if rvq_iter:
            scales, rotations = pc.vq_scale(scales)[0], pc.vq_rot(rotations)[0]
        scales, opacity = scales * mask, pc.get_opacity * mask
        colours = pc.mlp_head(pc.recolor(pc.get_xyz.detach()), away)
"""


class CompactHost(Derived):
    """A mask, codebooks, and colours from a network with an optimizer of its own."""

    lacks = {"checkpoint": "its checkpoints lack the mask and the network: it cannot resume them"}
    colour = frozenset({"hash grid", "colour network"})
    routine = ("densify and prune", "mask prune", "sort morton", "reset opacity")
    options = {
        "Loading": {"max_hashmap": 19, "rvq_size": 8, "rvq_num": 2},
        "Optimization": {
            "mask_prune_iter": 1_000,
            "rvq_iter": 29_000,
            "mask_lr": 0.01,
            "net_lr": 0.01,
            "net_lr_step": [5_000, 15_000, 25_000],
            "lambda_mask": 0.0005,
        },
    }
    flags = ('"--comp", action="store_true"', '"--store_npz", action="store_true"')
    cuts = {RENDERER: ("    shape = {", "    image, radii = GaussianRasterizer(", LOOK)}
    changes = {
        OPTIONS: [("        self.sh_degree = 3\n", "        self.sh_degree = 0\n")],
        RENDERER: [
            adding("    override_color=None,\n", after="    itr=-1,\n    rvq_iter=False,\n"),
            (
                "opacities=pc.get_opacity, **shape, **look\n",
                "opacities=opacity, scales=scales,\n        rotations=rotations, shs=colours,\n",
            ),
        ],
        MODEL: [
            adding(
                "from utils.sh_utils import RGB2SH\n",
                after="\nfrom scene.network import HashGrid, Head, ResidualVQ\n",
            ),
            ("            self._features_dc.transpose(1, 2).flatten(1),\n", ""),
            ("            self._features_rest.transpose(1, 2).flatten(1),\n", ""),
        ],
        SCENE: [
            (
                "gaussians.load_ply(self._ply(self.loaded_iter))",
                'gaussians.load_model(self._ply(self.loaded_iter).removesuffix(".ply"))',
            ),
            adding("def save(self, iteration", after=", compress=False, store=False"),
            (
                "self.gaussians.save_ply(self._ply(iteration))\n",
                "stored(self, iteration, compress, store)\n",
            ),
            adding("import numpy as np\n", after="import torch\n"),
            adding("\n\nclass Scene:", before="\n\n" + inspect.getsource(stored)),
        ],
        TRAIN: [
            adding("    debug_from,\n", after="    comp,\n    store_npz,\n"),
            ("GaussianModel(dataset.sh_degree)", "GaussianModel(dataset)"),
            ("pipe, bg)\n", "pipe, bg, itr=iteration, rvq_iter=iteration > opt.rvq_iter)\n"),
            adding(
                BACKWARD,
                before="        mask = torch.sigmoid(gaussians._mask)\n"
                "        loss = loss + opt.lambda_mask * mask.mean()\n",
            ),
            adding(
                "            training_report(",
                before="            if iteration == opt.iterations:\n"
                "                gaussians.final_prune(compress=comp)\n"
                "                gaussians.precompute()\n",
            ),
            ("scene.save(iteration)", "scene.save(iteration, compress=comp, store=store_npz)"),
            adding(STEP, before="            after_densification(iteration, opt, gaussians)\n"),
            adding(
                "                gaussians.optimizer.zero_grad(set_to_none=True)\n",
                after="                gaussians.optimizer_net.step()\n"
                "                gaussians.optimizer_net.zero_grad(set_to_none=True)\n"
                "                gaussians.scheduler_net.step()\n",
            ),
            adding("args.debug_from,\n", after="        args.comp,\n        args.store_npz,\n"),
        ],
    }
    functions = (after_densification,)
    added = (Growth, Added)
    files = {"scene/network.py": NETWORK}

    def new_model(self, degree: int) -> Any:
        from argparse import ArgumentParser

        parser = ArgumentParser()
        group = import_module("arguments").ModelParams(parser)
        model = import_module("scene.gaussian_model").GaussianModel
        return model(group.extract(parser.parse_args([])))

    def fill(self, model: Any, cloud: Any) -> None:
        """Some rows are masked already, not the first."""
        super().fill(model, cloud)
        with torch.no_grad():
            model._mask[3::8] = -9.0

    def render(self, camera: Any, model: Any, background: torch.Tensor) -> dict[str, Any]:
        """While it trains; once it is finished, as it is stored."""
        draw = import_module("gaussian_renderer").render
        finished = hasattr(model, "_feature")
        package: dict[str, Any] = draw(
            camera, model, self.pipe(), background, itr=-1 if finished else 1
        )
        return package

    def step(self, model: Any, camera: Any, iteration: int, background: torch.Tensor) -> float:
        """Codebooks learn in the forward pass, by a backward pass of their own."""
        model.update_learning_rate(iteration)
        draw = import_module("gaussian_renderer").render
        given = {"itr": iteration, "rvq_iter": iteration > 1}
        package = draw(camera, model, self.pipe(), background, **given)
        loss = (package["render"] - camera.original_image).abs().mean()
        loss = loss + 0.01 * torch.sigmoid(model._mask).mean()
        loss.backward()
        with torch.no_grad():
            self.gather(model, package)
            self.descend(model)
        return float(loss.detach())

    def descend(self, model: Any) -> None:
        super().descend(model)
        model.optimizer_net.step()
        model.optimizer_net.zero_grad(set_to_none=True)
        model.scheduler_net.step()

    def parameters(self, model: Any) -> dict[str, torch.Tensor]:
        nets = {"hash grid": model.recolor.params, "colour network": model.mlp_head.params}
        return {**super().parameters(model), **nets}

    def actions(self) -> dict[str, Action]:
        shared = super().actions()
        kept = ("prune", "clone", "split", "densify and prune", "reset opacity", "training setup")
        return {
            **{name: shared[name] for name in kept},
            "mask prune": lambda model, arguments, chance: model.mask_prune(),
            "sort morton": sort_morton,
        }

    def mark(self, model: Any, numbers: torch.Tensor) -> None:
        """In the rotations: colours belong to no row."""
        with torch.no_grad():
            model._rotation[:, 1] = numbers + 1

    def marks(self, model: Any) -> torch.Tensor:
        marks: torch.Tensor = model._rotation.detach()[:, 1].round().long() - 1
        return marks

    def save(self, model: Any, path: Path) -> None:
        """As training ends, and the PLY's network beside it."""
        finish(model)
        model.save_ply(str(path))
        nets = torch.nn.ModuleList([model.recolor, model.mlp_head])
        torch.save(nets.state_dict(), path.with_suffix(".pth"))

    def load(self, model: Any, path: Path) -> None:
        model.load_model(str(path.with_suffix("")))
        model.precompute()


def finish(model: Any) -> None:
    """What the last iteration does, once; a model that was never trained stays as it is."""
    if model.optimizer is not None and not hasattr(model, "_feature"):
        with torch.no_grad():
            model.final_prune()
            model.precompute()


def sort_morton(model: Any, arguments: Any, chance: Chance) -> None:
    """The last of all that the host does to rows: its optimizer is left behind, and here is not."""
    model.sort_morton()
    model.optimizer.state.clear()
    for group in model.optimizer.param_groups:
        group["params"][0] = getattr(model, f"_{group['name']}")
