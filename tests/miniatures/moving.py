"""A miniature 4DGaussians: the demo's host, and a network that moves its Gaussians with time."""

import copy
import inspect
from argparse import ArgumentParser
from importlib import import_module
from textwrap import indent
from types import SimpleNamespace

import torch

from fragprune_plugins.testing.host import FAINT
from fragprune_plugins.testing.rewriting import changed
from miniatures.family import MODEL, RADII, RENDERER, SCENE, TRAIN, Derived, Growth, Timed, adding


class Added:
    def __init__(self, sh_degree, args):
        self.vanilla_init(sh_degree)
        self._deformation = deform_network(args)  # noqa: F821 - imported where this is put
        self._deformation_table = torch.empty(0)

    def capture(self):
        degree, xyz, *others = self.vanilla_capture()
        return degree, xyz, self._deformation.state_dict(), self._deformation_table, *others

    def restore(self, model_args, training_args):
        degree, xyz, network, self._deformation_table, *others = model_args
        self._deformation.load_state_dict(network)
        self.vanilla_restore((degree, xyz, *others), training_args)

    def create_from_pcd(self, pcd, spatial_lr_scale, time_line):
        self.vanilla_create_from_pcd(pcd, spatial_lr_scale)
        self._deformation_table = torch.ones(len(self._xyz), dtype=torch.bool)

    def training_setup(self, training_args):
        self.vanilla_training_setup(training_args)
        given, extent, own = vars(training_args), self.spatial_lr_scale, []
        self.schedules = {"xyz": self.xyz_scheduler_args}
        for name, parameters in (
            ("deformation", self._deformation.get_mlp_parameters()),
            ("grid", self._deformation.get_grid_parameters()),
        ):
            first, last = (given[f"{name}_lr_{end}"] * extent for end in ("init", "final"))
            steps = training_args.position_lr_max_steps
            self.schedules[name] = get_expon_lr_func(first, last, steps)  # noqa: F821
            own.append({"params": parameters, "lr": first, "name": name})
        xyz, *others = self.optimizer.param_groups
        self.optimizer = torch.optim.Adam([xyz, *own, *others], lr=0.0, eps=1e-15)

    def update_learning_rate(self, iteration):
        for group in self.optimizer.param_groups:
            if group["name"] in self.schedules:
                group["lr"] = self.schedules[group["name"]](iteration)

    def save_deformation(self, path):
        parts = (self._deformation.state_dict(), self._deformation_table, self._deformation_accum)
        for name, part in zip(("", "_table", "_accum"), parts, strict=True):
            torch.save(part, f"{path}/deformation{name}.pth")

    def load_model(self, path):
        network, self._deformation_table, self._deformation_accum = (
            torch.load(f"{path}/deformation{name}.pth", map_location="cuda")
            for name in ("", "_table", "_accum")
        )
        self._deformation.load_state_dict(network)

    def _reset_statistics(self):
        self.vanilla_reset_statistics()
        self._deformation_accum = torch.zeros((len(self._xyz), 3))

    def prune_points(self, mask):
        self.vanilla_prune_points(mask)
        for name in ("_deformation_table", "_deformation_accum"):
            setattr(self, name, getattr(self, name)[~mask])

    def _children(self, chosen, copies):
        table = self._deformation_table
        self._deformation_table = torch.cat([table, table[chosen].repeat(copies)])
        return self.vanilla_children(chosen, copies)

    def densify(self, max_grad, min_opacity, extent, max_screen_size, *_):
        grads = (self.xyz_gradient_accum / self.denom).nan_to_num(0.0)
        self.densify_and_clone(grads, max_grad, extent)
        self.densify_and_split(grads, max_grad, extent)

    def prune(self, max_grad, min_opacity, extent, max_screen_size):
        unwanted = (self.get_opacity < min_opacity).squeeze(-1)
        if max_screen_size:
            unwanted |= self.max_radii2D > max_screen_size
            unwanted |= self.get_scaling.max(dim=1).values > 0.1 * extent
        self.prune_points(unwanted)

    def add_densification_stats(self, viewspace_point_tensor, update_filter):
        moved = torch.norm(viewspace_point_tensor[update_filter, :2], dim=-1, keepdim=True)
        self.xyz_gradient_accum[update_filter] += moved
        self.denom[update_filter] += 1

    def compute_regulation(self, weight):
        return weight * self._deformation.grid_planes.diff(dim=0).square().mean()


NETWORK = '''"""What a moment does to the Gaussians: features of a grid, a layer for each answer."""

import torch
from torch import nn


class deform_network(nn.Module):
    def __init__(self, args):
        super().__init__()
        self.grid_aabb = nn.Parameter(torch.ones(2, 3), requires_grad=False)
        self.grid_planes = nn.Parameter(torch.randn(args.resolution, args.net_width))
        sizes = {"xyz": 3, "scaling": 3, "rotation": 4}
        self.heads = nn.ModuleDict({k: nn.Linear(args.net_width + 3, n) for k, n in sizes.items()})
        self.timenet = nn.Linear(1, 2)  # never used
        self.register_buffer("time_poc", torch.ones(4))

    def get_mlp_parameters(self):
        return [p for name, p in self.named_parameters() if "grid" not in name]

    def get_grid_parameters(self):
        return [p for name, p in self.named_parameters() if "grid" in name]

    def forward(self, xyz, scaling, rotation, opacity, shs, time):
        place = time * (len(self.grid_planes) - 1)
        below = place.long().clamp(0, len(self.grid_planes) - 2)
        share = place - below
        planes = self.grid_planes
        at = planes[below[:, 0]] * (1 - share) + planes[below[:, 0] + 1] * share
        hidden = torch.cat([at, xyz], dim=1).sin()
        moved = {name: 0.1 * head(hidden) for name, head in self.heads.items()}
        turned = rotation + moved["rotation"]
        return xyz + moved["xyz"], scaling + moved["scaling"], turned, opacity, shs
'''

DEFORMED = """    now = torch.tensor(time).repeat(len(pc.get_xyz), 1)
    given = (pc.get_xyz, pc._scaling, pc._rotation, pc._opacity, pc.get_features)
    if "fine" in stage:
        given = pc._deformation(*given, now)
    xyz, scaling, rotation, opacity, shs = given
    rasterizer = GaussianRasterizer(raster_settings=settings)
    image, radii, depth = rasterizer(
        means3D=xyz,
        means2D=screenspace,
        shs=shs,
        colors_precomp=None,
        opacities=pc.opacity_activation(opacity),
        scales=pc.scaling_activation(scaling),
        rotations=pc.rotation_activation(rotation),
        cov3D_precomp=None,
    )
"""
CHOICE = """    else:
        settings, time = viewpoint_camera["camera"], viewpoint_camera["time"]
"""


def scene_reconstruction(opt, pipe, gaussians, scene, stage, train_iter, white):
    """One phase: it counts from 1, and saves under its own names."""
    iteration = 0
    gaussians.training_setup(opt)
    if args.start_checkpoint:  # noqa: F821 - the script's
        if stage == "coarse" and stage not in args.start_checkpoint:  # noqa: F821
            return
        if stage in args.start_checkpoint:  # noqa: F821
            model_params, iteration = torch.load(args.start_checkpoint)  # noqa: F821
            gaussians.restore(model_params, opt)
    cameras = scene.getTrainCameras()
    views = [Timed(view, time=number / len(cameras)) for number, view in enumerate(cameras)]
    background = torch.full((3,), float(white))
    waiting = []
    for iteration in range(iteration + 1, train_iter + 1):  # noqa: B020
        gaussians.update_learning_rate(iteration)
        if iteration % 1000 == 0:
            gaussians.oneupSHdegree()
        images, truths, moved, seen, radii = [], [], [], [], []
        for _ in range(opt.batch_size):
            waiting = waiting or copy.deepcopy(views)
            camera = waiting.pop(random.randrange(len(waiting)))  # noqa: F821
            package = render(camera, gaussians, pipe, background, stage=stage)  # noqa: F821
            images.append(package["render"])
            truths.append(camera.original_image)
            moved.append(package["viewspace_points"])
            seen.append(package["visibility_filter"])
            radii.append(package["radii"])
        loss = l1_loss(torch.stack(images), torch.stack(truths))  # noqa: F821
        if stage == "fine":
            loss = loss + gaussians.compute_regulation(opt.time_smoothness_weight)
        if iteration == opt.nan_at:
            loss = loss * float("nan")
        loss.backward()
        if torch.isnan(loss).any():
            print("loss is nan, end training, reexecv program now.")
            os.execv(sys.executable, [sys.executable, *sys.argv])  # noqa: F821
        with torch.no_grad():
            if iteration in args.save_iterations:  # noqa: F821
                scene.save(iteration, stage)
            if iteration < opt.densify_until_iter:
                update = torch.stack(seen).any(0)
                largest = torch.stack(radii).max(0).values.float()
                gaussians.max_radii2D[update] = torch.max(gaussians.max_radii2D, largest)[update]
                gaussians.add_densification_stats(sum(each.grad for each in moved), update)
                due = iteration % opt.densification_interval == 0
                if iteration > opt.densify_from_iter and due:
                    threshold, extent = opt.densify_grad_threshold, scene.cameras_extent
                    gaussians.densify(threshold, 0.005, extent, None, 5, 5, "", iteration, stage)
                    gaussians.prune(threshold, 0.005, extent, None)
                if iteration % opt.opacity_reset_interval == 0:
                    gaussians.reset_opacity()
            if iteration < opt.iterations:
                gaussians.optimizer.step()
                gaussians.optimizer.zero_grad(set_to_none=True)
            if iteration in args.checkpoint_iterations:  # noqa: F821
                path = f"{scene.model_path}/chkpnt_{stage}_{iteration}.pth"
                torch.save((gaussians.capture(), iteration), path)


def training(dataset, opt, pipe):
    """Two phases in one process."""
    dataset.model_path = args.model_path or os.path.join("output", args.expname)  # noqa: F821
    dataset.configs = args.configs  # noqa: F821 - it keeps all of its arguments
    prepare_output_and_logger(dataset)  # noqa: F821
    hidden = Namespace(net_width=args.net_width, resolution=args.resolution_t)  # noqa: F821
    gaussians = GaussianModel(dataset.sh_degree, hidden)  # noqa: F821
    scene = Scene(dataset, gaussians)  # noqa: F821
    for stage, last in (("coarse", opt.coarse_iterations), ("fine", opt.iterations)):
        scene_reconstruction(opt, pipe, gaussians, scene, stage, last, dataset.white_background)


class Entry:
    """Found in a ``Scene`` besides vanilla's methods."""

    def save(self, iteration, stage):
        name = f"coarse_iteration_{iteration}" if stage == "coarse" else f"iteration_{iteration}"
        folder = Path(self.model_path) / "point_cloud" / name  # noqa: F821
        self.gaussians.save_ply(str(folder / "point_cloud.ply"))
        self.gaussians.save_deformation(str(folder))


MERGE = """    args.save_iterations.append(args.iterations)
    if args.configs:
        import mmcv

        config = mmcv.Config.fromfile(args.configs)
        for group in ("OptimizationParams", "ModelHiddenParams", "ModelParams", "PipelineParams"):
            for key, value in config[group].items() if group in config.keys() else ():
                if hasattr(args, key):
                    setattr(args, key, value)
"""
LOADED = "            gaussians.load_ply(self._ply(self.loaded_iter))\n"
VIEWS = '    for index, view in enumerate(tqdm(views, desc=f"Rendering {name}")):\n'
OF_GROUPS = "            for group in self.optimizer.param_groups\n"
IDLE = ("timenet", "opacity_deform", "shs_deform")
"""Parts of the network that its defaults leave unused."""


class MovingHost(Derived):
    """Small Gaussians, and a smaller network."""

    routine = ("densify", "prune faint", "reset opacity", "another band")
    moment = 0.3
    options = {
        "Optimization": {
            "coarse_iterations": 6,
            "batch_size": 2,
            "deformation_lr_init": 0.002,
            "deformation_lr_final": 0.0002,
            "grid_lr_init": 0.01,
            "grid_lr_final": 0.001,
            "time_smoothness_weight": 0.01,
            "nan_at": -1,
        }
    }
    flags = (
        *('"--configs", type=str, default=""', '"--expname", type=str, default=""'),
        *('"--net_width", type=int, default=6', '"--resolution_t", type=int, default=5'),
    )
    changes = {
        MODEL: [
            adding("torch import nn\n", after="from scene.deformation import deform_network\n"),
            adding(
                "[mask], lambda moment: moment[mask]\n            )\n" + OF_GROUPS,
                after='            if len(group["params"]) == 1\n',
            ),
            adding(
                '            new = tensors_dict[group["name"]]\n',
                before='            if len(group["params"]) > 1:\n                continue\n',
            ),
        ],
        SCENE: [
            adding(
                LOADED,
                after="            folder = Path(self._ply(self.loaded_iter)).parent\n"
                "            gaussians.load_model(folder)\n",
            ),
            ("self.cameras_extent)\n\n", "self.cameras_extent, 0)\n\n"),
        ],
        TRAIN: [
            adding("import random\n", before="import copy\nimport os\n"),
            ("    args.save_iterations.append(args.iterations)\n", MERGE),
        ],
        "render.py": [
            (
                "        gaussians = GaussianModel(dataset.sh_degree)\n",
                "        hidden = Namespace(net_width=6, resolution=5)\n"
                "        gaussians = GaussianModel(dataset.sh_degree, hidden)\n",
            ),
            ("import ArgumentParser\n", "import ArgumentParser, Namespace\n"),
            adding(VIEWS, after="        view.time = index / len(views)\n"),
        ],
    }
    functions = (Timed, scene_reconstruction, training)
    added = (Growth, Added)
    files = {"scene/deformation.py": NETWORK}
    gone = {
        MODEL: ("densify_and_prune",),
        SCENE: ("save",),
        TRAIN: ("training", "densify", "training_report"),
    }

    def write(self, root):
        super().write(root)
        scene, script, renderer = root / SCENE, root / TRAIN, root / RENDERER
        scene.write_text(scene.read_text() + "\n" + inspect.getsource(Entry.save))
        text = script.read_text()
        begun = text.index("    training(\n")
        call = "    training(lp.extract(args), op.extract(args), pp.extract(args))\n"
        script.write_text(text[:begun] + call)
        text = renderer.read_text()
        marks = ("    settings = Gauss", "    shape = {", "    return {")
        begin, middle, end = (text.index(each) for each in marks)
        known = '    if cam_type != "PanopticSports":\n'
        known += indent(text[begin:middle] + "    time = viewpoint_camera.time\n", " " * 4)
        text = text[:begin] + known + CHOICE + DEFORMED + text[end:]
        more = '    stage="fine",\n    cam_type=None,\n'
        changes = [
            adding("    override_color=None,\n", after=more),
            adding(RADII, after='        "depth": depth,\n'),
        ]
        renderer.write_text(changed(text, changes))

    # -- driving, which works on a real checkout too ---------------------------------------------

    def new_model(self, degree):
        arguments = import_module("arguments")
        hidden = SimpleNamespace(net_width=6, resolution=5)
        if kind := getattr(arguments, "ModelHiddenParams", None):
            parser = ArgumentParser()
            hidden = kind(parser).extract(parser.parse_args([]))
            hidden.multires, hidden.net_width = [1], 8
            hidden.kplanes_config = {**hidden.kplanes_config, "resolution": [8, 8, 8, 5]}
        torch.manual_seed(3)
        return import_module("scene.gaussian_model").GaussianModel(degree, hidden)

    def camera(self, width, height, *, side=0.0):
        return Timed(super().camera(width, height, side=side), time=self.moment)

    def gather(self, model, package):
        moved = package["viewspace_points"].grad
        model.add_densification_stats(moved, package["visibility_filter"])

    def parameters(self, model):
        network = dict(model._deformation.named_parameters())
        groups = {each["name"]: each["params"] for each in model.optimizer.param_groups}
        alone = {name: group[0] for name, group in groups.items() if len(group) == 1}
        return alone | {
            name: parameter
            for name, parameter in network.items()
            if parameter.requires_grad and not any(part in name for part in IDLE)
        }

    def save(self, model, path):
        super().save(model, path)
        if not hasattr(model, "_deformation_accum"):  # training_setup makes it
            model._deformation_accum = torch.zeros(len(model.get_xyz), 3)
        model.save_deformation(str(path.parent))

    def load(self, model, path):
        super().load(model, path)
        model.load_model(str(path.parent))

    def actions(self):
        known = super().actions()
        del known["densify and prune"]
        return {**known, "densify": densify, "prune faint": prune_faint}


def densify(model, arguments, chance):
    n = len(model.get_xyz)
    model.xyz_gradient_accum = chance.uniform(n, 1)
    model.denom = chance.rows(n, 0.8)[:, None].float()
    model.densify(1 - chance.share, 0.005, 3.0, None, 5, 5)


def prune_faint(model, arguments, chance):
    n = len(model.get_xyz)
    with torch.no_grad():
        model._opacity[chance.rows(n, chance.share / 2)] = FAINT
    model.max_radii2D = 22 * chance.uniform(n)
    model.prune(1 - chance.share, 0.005, 30.0, 20 if chance.heads else None)
